"""Safety assessment for robots in Drake: beforehand, will this motion stay safe?"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from drake_safety.assessments import load_assessment
    from drake_safety.learning.assessment import SafetyAssessment
    from drake_safety.learning.assessment_parameters import AssessmentParameters
    from drake_safety.learning.segments import Episode, Episodes
    from drake_safety.simulation.closed_loop import ClosedLoop
    from drake_safety.simulation.contract import check_contract
    from drake_safety.simulation.recording import record_episodes
    from drake_safety.simulation.rollouts import run_episode, run_episodes
    from drake_safety.simulation.scenario import Scenario, load_scenario
    from drake_safety.systems.recovery_switch import RecoverySwitch
    from drake_safety.systems.safety_assessor import AddSafetyAssessor, SafetyAssessor

__all__ = [
    "AddSafetyAssessor",
    "AssessmentParameters",
    "ClosedLoop",
    "Episode",
    "Episodes",
    "RecoverySwitch",
    "SafetyAssessment",
    "SafetyAssessor",
    "Scenario",
    "__version__",
    "check_contract",
    "load_assessment",
    "load_scenario",
    "record_episodes",
    "run_episode",
    "run_episodes",
]

# In a checkout `models`, `diagrams` and `assessments` stand beside this package, in a wheel inside
# it.
if not (Path(__file__).parent / "models").is_dir():
    __path__.append(str(Path(__file__).resolve().parents[1]))

# Resolved on first use: an online run needs neither the training code nor the rollouts.
_HOMES = {
    "AddSafetyAssessor": "drake_safety.systems.safety_assessor",
    "AssessmentParameters": "drake_safety.learning.assessment_parameters",
    "ClosedLoop": "drake_safety.simulation.closed_loop",
    "Episode": "drake_safety.learning.segments",
    "Episodes": "drake_safety.learning.segments",
    "RecoverySwitch": "drake_safety.systems.recovery_switch",
    "SafetyAssessment": "drake_safety.learning.assessment",
    "SafetyAssessor": "drake_safety.systems.safety_assessor",
    "Scenario": "drake_safety.simulation.scenario",
    "check_contract": "drake_safety.simulation.contract",
    "load_assessment": "drake_safety.assessments",
    "load_scenario": "drake_safety.simulation.scenario",
    "record_episodes": "drake_safety.simulation.recording",
    "run_episode": "drake_safety.simulation.rollouts",
    "run_episodes": "drake_safety.simulation.rollouts",
}


def __getattr__(name: str) -> Any:
    """Resolves a public name on first use."""
    if name == "__version__":
        value: Any = _version()
    elif name in _HOMES:
        value = getattr(import_module(_HOMES[name]), name)
    else:
        raise AttributeError(f"module 'drake_safety' has no attribute {name!r}; it has {__all__}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Lists the names not resolved yet beside the resolved ones."""
    return sorted({*globals(), *__all__})


def _version() -> str:
    """Returns the installed version, or one that says the code runs uninstalled."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("drake_safety")
    except PackageNotFoundError:
        return "0+uninstalled"
