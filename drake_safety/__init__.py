"""Safety assessment for robots in Drake: beforehand, will this motion stay safe?"""

import sys
from importlib import import_module
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_file_location
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from drake_safety.assessments import load_assessment as load_assessment
    from drake_safety.evaluation.loop_comparison import compare_loops as compare_loops
    from drake_safety.learning.assessment import AssessmentParameters as AssessmentParameters
    from drake_safety.learning.assessment import SafetyAssessment as SafetyAssessment
    from drake_safety.learning.change_detector import ChangeDetector as ChangeDetector
    from drake_safety.learning.segments import Episode as Episode
    from drake_safety.learning.segments import Episodes as Episodes
    from drake_safety.robots.shift import Fault as Fault
    from drake_safety.simulation.closed_loop import ClosedLoop as ClosedLoop
    from drake_safety.simulation.contract import check_contract as check_contract
    from drake_safety.simulation.episode_start import EpisodeStart as EpisodeStart
    from drake_safety.simulation.recording import record_episodes as record_episodes
    from drake_safety.simulation.rollouts import inputs_at as inputs_at
    from drake_safety.simulation.rollouts import run_episode as run_episode
    from drake_safety.simulation.rollouts import run_episodes as run_episodes
    from drake_safety.simulation.rollouts import run_motions as run_motions
    from drake_safety.simulation.scenario import Scenario as Scenario
    from drake_safety.simulation.scenario import load_scenario as load_scenario
    from drake_safety.systems.change_monitor import ChangeMonitor as ChangeMonitor
    from drake_safety.systems.monitored_assessor import AddSafetyAssessor as AddSafetyAssessor
    from drake_safety.systems.monitored_assessor import (
        MonitoredSafetyAssessor as MonitoredSafetyAssessor,
    )
    from drake_safety.systems.recovery_switch import RecoverySwitch as RecoverySwitch
    from drake_safety.systems.safety_assessor import SafetyAssessor as SafetyAssessor
    from drake_safety.systems.sensor_faults import SensorFaults as SensorFaults

_PACKAGE = Path(__file__).resolve().parent
_BESIDE = ("assessments", "diagrams", "models")


class _CheckoutFinder:
    """Finds in a checkout what stands beside this package, by the name that it is installed as.

    An editable install's finder does so too, but for its own checkout alone.
    """

    @staticmethod
    def find_spec(name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        """The module's spec; None for any but the three."""
        parent, _, child = name.rpartition(".")
        if parent != __name__ or child not in _BESIDE:
            return None
        folder = _PACKAGE.parent / child
        return spec_from_file_location(
            name, folder / "__init__.py", submodule_search_locations=[str(folder)]
        )


if not (_PACKAGE / "models").is_dir():
    sys.meta_path.insert(0, _CheckoutFinder)

# Resolved on first use: an online run needs neither the training code nor the rollouts.
_HOMES = {
    "AddSafetyAssessor": "drake_safety.systems.monitored_assessor",
    "AssessmentParameters": "drake_safety.learning.assessment_parameters",
    "ChangeDetector": "drake_safety.learning.change_detector",
    "ChangeMonitor": "drake_safety.systems.change_monitor",
    "ClosedLoop": "drake_safety.simulation.closed_loop",
    "Episode": "drake_safety.learning.segments",
    "EpisodeStart": "drake_safety.simulation.episode_start",
    "Episodes": "drake_safety.learning.segments",
    "Fault": "drake_safety.robots.shift",
    "MonitoredSafetyAssessor": "drake_safety.systems.monitored_assessor",
    "RecoverySwitch": "drake_safety.systems.recovery_switch",
    "SafetyAssessment": "drake_safety.learning.assessment",
    "SafetyAssessor": "drake_safety.systems.safety_assessor",
    "Scenario": "drake_safety.simulation.scenario",
    "SensorFaults": "drake_safety.systems.sensor_faults",
    "check_contract": "drake_safety.simulation.contract",
    "compare_loops": "drake_safety.evaluation.loop_comparison",
    "inputs_at": "drake_safety.simulation.rollouts",
    "load_assessment": "drake_safety.assessments",
    "load_scenario": "drake_safety.simulation.scenario",
    "record_episodes": "drake_safety.simulation.recording",
    "run_episode": "drake_safety.simulation.rollouts",
    "run_episodes": "drake_safety.simulation.rollouts",
    "run_motions": "drake_safety.simulation.rollouts",
}
__all__ = [*_HOMES, "__version__"]


def __getattr__(name: str) -> Any:
    """Resolves a public name on first use."""
    if name == "__version__":
        segments = import_module("drake_safety.learning.segments")
        value: Any = segments.installed_versions()["drake_safety"]
    elif name in _HOMES:
        value = getattr(import_module(_HOMES[name]), name)
    else:
        raise AttributeError(f"module 'drake_safety' has no attribute {name!r}; it has {__all__}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Lists all names, resolved or not."""
    return sorted({*globals(), *__all__})
