"""The composition guide: the example that it explains, its table and picture, and its parts."""

import re
from pathlib import Path

import numpy as np
import pytest
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.analysis import Simulator

import compose
from command_line import python
from drake_safety.control.safe_sets import BalanceSafeSet
from drake_safety.systems.assessor_inputs import AssessorInputs

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs/own_diagram.md").read_text(encoding="utf-8")
GUIDE = PAGE.partition("## From single parts")[2].partition("\n## ")[0]
PARTS = re.findall(r"### Your (\w+)\n.*?```python\n(.*?)```", GUIDE, flags=re.DOTALL)


def connections(diagram):
    """Pairs of `system.port`, with their size; the SceneGraph's are Drake's own matter."""
    for (other, u), (one, y) in diagram.connection_map().items():
        port = one.get_output_port(y)
        ends = [f"{one.get_name()}.{port.get_name()}"]
        ends.append(f"{other.get_name()}.{other.get_input_port(u).get_name()}")
        if "scene_graph" not in {one.get_name(), other.get_name()}:
            yield *ends, port.size()


def test_the_example_is_short_and_its_robot_that_is_pushed_steps_and_stands_again():
    file = Path(compose.__file__)
    assert len(file.read_text(encoding="utf-8").splitlines()) <= 80
    found = re.findall(r"(\S+) s  Γ (\S+)  nearest limit (\S+) cm", python(file))
    gamma, limit = np.array(found, dtype=float).T[1:]
    assert gamma[0] < compose.RECOVERY.threshold
    assert limit.min() < 0.0  # On two legs.
    assert gamma[-1] > 0.9
    assert limit[-1] > 5.0


def test_table_and_picture_of_the_guide_show_every_connection():
    rows = re.findall(r"^\| (`[\w.]+`) \| ([^|]+) \| (\d+) \|", GUIDE, flags=re.MULTILINE)
    listed = {
        (one.strip("`"), other, int(size))
        for one, others, size in rows
        for other in re.findall(r"`([\w.]+)`", others)
    }
    diagram = compose.compose()
    ends = list(connections(diagram))
    assert listed == set(ends)
    picture = (ROOT / "docs/pictures/compose.svg").read_text(encoding="utf-8")
    assert picture.count('class="edge"') == len(ends)
    words = set(re.findall(r"> ?([^<\n]+)</text>", picture))
    assert {word for *pair, _ in ends for end in pair for word in end.split(".")} <= words


@pytest.mark.parametrize("number", range(3), ids=[name for name, _ in PARTS[:3]])
def test_a_part_of_ones_own_takes_the_place_of_ours(number):
    names = {}
    for _, lines in PARTS[: number + 1]:
        exec(lines, names)
    diagram = names["diagram"]
    simulator = Simulator(diagram)
    for time_s in (0.0, 0.5):
        simulator.AdvanceTo(time_s)
        values = [diagram.GetOutputPort(one) for one in ("safety_probability", "margins")]
        gamma, margins = (port.Eval(simulator.get_context()) for port in values)
        assert gamma[0] > 0.4
        assert margins.min() > 0.05


def test_episodes_of_a_diagram_of_ones_own_begin_with_what_its_assessor_sees():
    names = {}
    for _, lines in PARTS:
        exec(lines, names)
    episode = next(iter(names["episodes"]))
    diagram = names["make_diagram"]()
    simulator = Simulator(diagram)
    names["reset"](diagram, context := simulator.get_mutable_context(), np.random.default_rng(0))
    v = diagram.GetSubsystemByName("plant")
    v.SetVelocities(v.GetMyMutableContextFromRoot(context), np.pad(episode.state[0, 9:11], (3, 13)))
    simulator.AdvanceTo(0.001)  # Assessed at 0 s, and not yet again.
    rows = (getattr(episode, one)[0] for one in ("state", "desired_preview", "features"))
    assessed = diagram.GetOutputPort("safety_probability").Eval(context)
    assert assessed == pytest.approx([compose.GAMMA.predict_one(*rows).probability])


def test_a_plant_that_shows_its_next_state_is_warned_of(caplog):
    def add_plant(builder):
        plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.001)
        plant.set_name("other_plant")
        plant.Finalize()
        scene_graph.set_name("other_scene_graph")
        return compose.add_plant(builder)

    compose.compose()
    assert not caplog.records
    compose.compose(add_plant)
    assert "use_sampled_output_ports=False" in caplog.text


def test_the_assessors_inputs_are_what_the_assessment_reads():
    safe_set = BalanceSafeSet(compose.ROBOT, compose.LIMITS)
    whole = AssessorInputs(compose.ROBOT, safe_set, gravity=[0.0, 0.0, -9.81], servo_loads=True)
    info = compose.GAMMA.info_
    assert whole.feature_names == compose.GAMMA.feature_names
    assert [whole.state_names, whole.constraint_names] == [info.state_names, info.constraint_names]
