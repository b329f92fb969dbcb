import logging
from pathlib import Path

import numpy as np
import pytest
from pydrake.common import RandomDistribution
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, EventStatus, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource, RandomSource, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

import quadrotor
from cart_episodes import assert_identical
from command_line import python
from drake_safety import record_episodes
from drake_safety.learning.segments import DIVERGED, EpisodeError
from drake_safety.simulation.dataset import completed, load_episodes
from drake_safety.simulation.rollouts import episode_rng
from toy_tasks import GlidingParameters, Mass

STEP_S = 0.1
NAMES = {"state": "position_and_speed"}
# The example without what is said and drawn of the result.
QUADROTOR = Path(quadrotor.__file__).read_text().partition("\n\n\ndef main(")[0]


def make_glider(failure="", wall_m=1.0, mass=None):
    builder = DiagramBuilder()
    parameters = GlidingParameters(failure=failure, wall_m=wall_m)
    mass = builder.AddNamedSystem("mass", mass or Mass(parameters, 5))
    for name in ("state", "output", "desired_preview", "margins"):
        builder.ExportOutput(mass.GetOutputPort(name), NAMES.get(name, name))
    return builder.Build()


def reset_glider(diagram, context, rng):
    context.SetDiscreteState([rng.uniform(-0.3, 0.3), rng.uniform(-2, 2)])
    return 1


def record(num_episodes=10, *, make=make_glider, reset=reset_glider, **options):
    defaults = {"duration_s": 1.0, "step_s": STEP_S, "num_workers": 1}
    defaults |= {"ports": NAMES}
    return record_episodes(make, num_episodes, reset=reset, **(defaults | options))


def test_what_is_left_out_has_its_default():
    episodes = record()
    assert episodes.info.horizon == 5
    assert episodes.info.num_steps == 10
    assert episodes.info.scenario == "make_glider"
    assert episodes.info.state_names == ["state_0", "state_1"]
    assert 0 < episodes.num_unsafe < 10
    for episode in episodes:
        assert episode.first_step == min(1, episode.num_steps)
        assert episode.features.shape == (len(episode.time_s), 0)
        np.testing.assert_array_equal(episode.true_state, episode.state)
        np.testing.assert_array_equal(episode.desired_output, episode.desired_preview[:, :3])
        assert episode.is_safe == (episode.margins.min() >= 0)
        if not episode.is_safe:
            assert -0.0201 < episode.margins[-1].min() < 0  # A look a hundredth of a second.
        x, v = episode.state[0]
        np.testing.assert_allclose(episode.state[:, 0], x + v * episode.time_s, atol=1e-9)


def make_ramp(sample_s):
    """A plan that moves at 1 m/s, and its preview of three samples ``sample_s`` apart."""
    builder = DiagramBuilder()
    first = {"state": [0.0], "output": [0.0], "margins": [1.0]}
    for name, values in (first | {"desired_preview": sample_s * np.arange(3.0)}).items():
        line = PiecewisePolynomial.FirstOrderHold([0.0, 9.0], np.add.outer(values, [0.0, 9.0]))
        builder.ExportOutput(builder.AddSystem(TrajectorySource(line)).get_output_port(), name)
    return builder.Build()


@pytest.mark.parametrize(("sample_s", "stride"), [(0.1, 1), (0.3, 3), (0.25, 1)])
def test_a_preview_whose_samples_are_further_apart_than_said_is_named(sample_s, stride, caplog):
    options = {"make": lambda: make_ramp(sample_s), "reset": lambda *start: 0, "ports": {}}
    assert record(2, **options).info.preview_step_s == pytest.approx(0.1)
    assert ("pass preview_stride=3; got 1" in caplog.text) == (stride == 3)
    caplog.clear()
    stated = record(2, preview_stride=stride, **options)
    assert stated.info.preview_step_s == pytest.approx(stride * STEP_S)
    assert "preview_stride" not in caplog.text


@pytest.mark.train
def test_a_folder_goes_on_with_its_own_set_and_refuses_others(tmp_path):
    record(4, path=tmp_path, reset=lambda *start: np.int32(reset_glider(*start)))
    assert completed(tmp_path) == {0, 1, 2, 3}
    assert_identical(record(10, path=tmp_path), record(10))
    assert_identical(load_episodes(tmp_path), record(10))
    for other in ({"seed": 1}, {"duration_s": 2.0}, {"parameters": {"wall_m": 0.9}}):
        with pytest.raises(ValueError, match="of another set"):
            record(10, path=tmp_path, **other)


@pytest.mark.train
def test_episodes_of_what_has_changed_since_are_refused_and_those_kept_are_counted(
    tmp_path, caplog
):
    wall_m = 1.0

    def make():
        return make_glider(wall_m=wall_m)

    record(4, make=make, path=tmp_path)
    assert not caplog.records
    record(6, make=make, path=tmp_path)
    assert f"4 of 6 episodes are kept from {tmp_path}" in caplog.text
    other = {"reset": lambda diagram, context, rng: context.SetDiscreteState([0.0, 1.0])}
    with pytest.raises(ValueError, match=r"6 episodes .* not the same any more: episode \d, sim"):
        record(6, make=make, path=tmp_path, **other)
    wall_m = 0.9
    for num_episodes in (6, 8):
        with pytest.raises(ValueError, match="not the same any more"):
            record(num_episodes, make=make, path=tmp_path)
    assert len(completed(tmp_path)) == 6


class Keeper(Mass):
    """A mass that is pushed by state that is not in the Context."""

    def __init__(self, kind):
        super().__init__(GlidingParameters(), 5)
        self.integral, self.first, self.kind = 0.0, None, kind
        self.rng = np.random.default_rng(0)

    def _update(self, context, discrete_state):
        super()._update(context, discrete_state)
        x = discrete_state[0]
        self.integral += x
        self.first = x if self.first is None else self.first
        kept = {"memory": self.integral, "random": self.rng.normal(), "cache": self.first}
        discrete_state[1] += 1e-3 * kept.get(self.kind, 0.0)


@pytest.mark.parametrize(
    ("kind", "num_workers"), [("none", 1), ("memory", 2), ("random", 1), ("cache", 1)]
)
def test_state_that_a_system_keeps_in_an_attribute_is_an_error(kind, num_workers):
    options = {"make": lambda: make_glider(mass=Keeper(kind)), "num_workers": num_workers}
    if kind == "none":
        assert len(record(8, **options)) == 8
        return
    with pytest.raises(ValueError, match=r"0 of '<lambda>', .* keeps state outside its Context"):
        record(8, **options)


def test_a_diverged_simulation_is_counted_and_a_mistake_is_an_error(caplog):
    with caplog.at_level(logging.WARNING, logger="drake_safety"):
        record()
        assert not caplog.records
        record(parameters={"wall_m": 9.0})
        assert "is unsafe after its first row" in caplog.text
        episodes = record(parameters={"failure": "raise"})
    assert episodes.num_diverged == sum(e.cause == DIVERGED for e in episodes) > 0
    assert f"{episodes.num_diverged} of 10 simulations of 'make_glider'" in caplog.text
    with pytest.raises(EpisodeError, match=r"episode \d of 'make_glider' \(seed 0\): RuntimeError"):
        record(parameters={"failure": "bug"})
    with pytest.raises(EpisodeError, match=r"episode 0 of 'make_glider' \(seed 0\), reset: Type"):
        record(reset=lambda diagram, context, rng: context + 1)
    with pytest.raises(EpisodeError, match=r"reset: .* expected the first row, 0 to 10; got 99"):
        record(reset=lambda diagram, context, rng: 99)


def reset_outside(diagram, context, rng):
    """A start of which the first one is outside the safe set."""
    if rng.random() == episode_rng(0, 0).random():
        return context.SetDiscreteState([2.0, 0.0])
    return reset_glider(diagram, context, rng)


@pytest.mark.train
def test_an_episode_that_ends_at_its_start_vouches_for_no_diagram(tmp_path):
    options = {"reset": reset_outside, "path": tmp_path, "name": "glider"}
    assert record(3, **options)[0].num_steps == 0
    with pytest.raises(ValueError, match=r"not the same any more: episode [12], sim"):
        record(3, **options, make=lambda: make_glider(wall_m=0.1))
    with pytest.raises(ValueError, match=r"1 of '<lambda>', .* keeps state outside its Context"):
        record(reset=reset_outside, make=lambda: make_glider(mass=Keeper("memory")))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"ports": {}}, r"exports no port \['state'\] for \['state'\]; it exports .*'margins'"),
        ({"ports": {"state": "output", "output": "margins"}}, "size 15 of .* is not H \\* 2"),
        ({"constraint_names": ["wall"]}, "constraint_names has 1 names; expected 2"),
        (
            {"ports": NAMES | {"safe": "margins"}},
            "state and margins need entries, and safe has one",
        ),
        ({"make": lambda: None}, "make_diagram must return a Diagram; got NoneType"),
        ({"preview_stride": 1.5}, "preview_stride must be an integer from 1 on; got 1.5"),
        ({"plants": 0}, "plants must be an integer from 1 on; got 0"),
        ({"duration_s": 1.05}, "duration_s must be a multiple of step_s; got 1.05 and 0.1"),
    ],
)
def test_what_does_not_fit_is_refused_with_what_there_is(options, message):
    with pytest.raises(ValueError, match=message):
        record(1, **options)


def test_a_drake_plant_that_diverges_is_no_mistake():
    from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
    from pydrake.multibody.tree import SpatialInertia

    def make(force):
        builder = DiagramBuilder()
        plant, _ = AddMultibodyPlantSceneGraph(builder, time_step=0.01)
        plant.AddRigidBody("body", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
        plant.Finalize()
        glider = builder.AddSystem(make_glider())
        forces = builder.AddSystem(ConstantVectorSource(np.full(6, force)))
        builder.Connect(forces.get_output_port(), plant.get_applied_generalized_force_input_port())
        for name in ("position_and_speed", "output", "desired_preview", "margins"):
            builder.ExportOutput(glider.GetOutputPort(name), name)
        return builder.Build()

    for force, num_diverged in ((1.0, 0), (np.nan, 1)):
        options = {"reset": lambda *start: 0, "parameters": {"force": force}}
        assert record(1, make=make, **options).num_diverged == num_diverged


@pytest.mark.train
def test_from_an_empty_file_to_gamma_in_a_diagram_of_pydrakes_own():
    assert len(QUADROTOR.splitlines()) <= 60
    assessment = quadrotor.learn(
        200, num_workers=1, epochs=20, ensemble_size=1, hidden_sizes=[16], perplexity=10
    )
    diagram = quadrotor.make_diagram(assessment)
    gamma = []
    for share in (0.0, 1.0):
        simulator = Simulator(diagram)
        context = simulator.get_mutable_context()
        plant = diagram.GetSubsystemByName("quadrotor")
        start = np.append(quadrotor.GOAL, np.zeros(9)) + share * quadrotor.START
        plant.GetMyMutableContextFromRoot(context).SetContinuousState(start)
        simulator.Initialize()
        gamma.append(diagram.GetOutputPort("gamma").Eval(context)[0])
    assert gamma[0] > 0.6 > gamma[1]


@pytest.mark.train
def test_what_a_script_or_notebook_defines_reaches_the_workers(tmp_path):
    script = tmp_path / "mine.py"
    script.write_text(
        QUADROTOR + "\n\ntimes = {'duration_s': 2.0, 'step_s': STEP_S}\n"
        "sets = [record_episodes(make_diagram, 8, reset=reset, num_workers=n, **times)\n"
        "        for n in (1, 2)]\n"
        "for one, other in zip(*sets, strict=True):\n"
        "    np.testing.assert_array_equal(one.state, other.state)\n"
    )
    python(script)


@pytest.mark.parametrize("begin_s", [0.07, 1.76e9])
def test_rows_count_from_the_time_that_reset_sets(begin_s):
    def reset(diagram, context, rng):
        context.SetTime(begin_s)
        return reset_glider(diagram, context, rng)

    for episode, usual in zip(record(6, reset=reset), record(6), strict=True):
        assert episode.cause == usual.cause
        x, v = episode.state[0]
        np.testing.assert_allclose(episode.state[:, 0], x + v * episode.time_s, atol=0.0201)
        np.testing.assert_array_equal(episode.time_s[:-1], usual.time_s[:-1])


class Referee(LeafSystem):
    """Ends the simulation, or fails, from a time on, by an event of a kind."""

    def __init__(self, kind, end_s, status):
        super().__init__()
        self.DeclareDiscreteState(1)

        def judge(context, *state):
            is_over = context.get_time() > end_s - 1e-9
            return status(self) if is_over else EventStatus.DidNothing()

        declare = {
            "step": self.DeclarePerStepPublishEvent,
            "publish": lambda judge: self.DeclarePeriodicPublishEvent(0.005, 0.0, judge),
            "update": lambda judge: self.DeclarePeriodicDiscreteUpdateEvent(0.01, 0.0, judge),
            "start": self.DeclareInitializationPublishEvent,
        }
        declare[kind](judge)


def make_refereed(kind, end_s, status=lambda one: EventStatus.ReachedTermination(one, "over")):
    builder = DiagramBuilder()
    glider = builder.AddNamedSystem("glider", make_glider())
    builder.AddNamedSystem("referee", Referee(kind, end_s, status))
    for port in map(glider.get_output_port, range(4)):
        builder.ExportOutput(port, port.get_name())
    return builder.Build()


def reset_refereed(diagram, context, rng):
    glider = diagram.GetSubsystemByName("glider").GetMyMutableContextFromRoot(context)
    reset_glider(diagram, glider, rng)


@pytest.mark.parametrize(
    ("kind", "end_s"), [("step", 0.25), ("publish", 0.255), ("update", 0.3), ("start", 0.0)]
)
def test_an_episode_ends_where_a_system_ends_the_simulation(caplog, kind, end_s):
    make, usual = lambda: make_refereed(kind, end_s), record(6)
    for one, other in zip(record(6, make=make, reset=reset_refereed), usual, strict=True):
        if other.time_s[-1] < end_s:  # It has left the safe set before.
            assert (one.cause, one.time_s[-1]) == (other.cause, other.time_s[-1])
            continue
        assert one.is_safe and one.time_s[-1] == pytest.approx(end_s, abs=0.0101)
        assert (np.diff(one.time_s) > 0).all()
        num_rows = len(one.time_s) - 1
        np.testing.assert_array_equal(one.state[:num_rows], other.state[:num_rows])
    assert f"a system of '{make.__name__}' ended" in caplog.text


def test_an_event_that_fails_is_an_error_with_system_and_reason():
    def make():
        return make_refereed("update", 0.3, lambda one: EventStatus.Failed(one, "the gear broke"))

    failed = EventStatus.Failed
    told = r"episode 0 .*\(seed 0\): RuntimeError: system 'referee' failed: the gear broke"
    with pytest.raises(EpisodeError, match=told):
        record(1, make=make, reset=reset_refereed)
    assert EventStatus.Failed is failed


def test_noise_of_drakes_random_sources_depends_on_seed_and_index_alone():
    def make():
        builder, inner = DiagramBuilder(), DiagramBuilder()
        for distribution in (RandomDistribution.kGaussian, RandomDistribution.kUniform):
            source = inner.AddSystem(RandomSource(distribution, 2, 0.05))
            inner.ExportOutput(source.get_output_port(), distribution.name)
        noise = builder.AddNamedSystem("noise", inner.Build())
        ones = builder.AddNamedSystem("ones", ConstantVectorSource(np.ones(2)))
        builder.ExportOutput(noise.GetOutputPort("kGaussian"), "state")
        builder.ExportOutput(noise.GetOutputPort("kUniform"), "output")
        for name in ("desired_preview", "margins"):
            builder.ExportOutput(ones.get_output_port(), name)
        return builder.Build()

    options = {"make": make, "reset": lambda *start: None, "ports": None, "name": "noisy"}
    episodes = record(8, num_workers=2, **options)
    assert_identical(episodes, record(8, **options))
    drawn = [one.state.tobytes() for one in (*episodes, *record(2, seed=1, **options))]
    assert len(set(drawn)) == 10
    assert np.abs(episodes[0].output - episodes[0].state).min() > 0.0


def test_a_margin_of_infinity_is_an_error_that_names_its_constraint():
    told = "constraint 'gap' has a margin of inf at 0 s; cap it at a finite distance"
    with pytest.raises(EpisodeError, match=told):
        record(1, parameters={"wall_m": np.inf}, constraint_names=["gap", "wall"])


def make_between_walls(wall_m=1.0):
    return make_glider(wall_m=wall_m)


@pytest.mark.train
def test_a_sampler_draws_plants_for_episodes_in_turn(tmp_path):
    drawn = {"make": make_between_walls, "plants": 3, "seed": 5}
    drawn["draw_plant"] = lambda rng: rng.uniform(1.0, 3.0)
    family, nominal = record(9, **drawn), record(9, make=make_between_walls, seed=4)
    assert (family.info.variation, nominal.info.variation) == ("family", "nominal")
    assert [one.plant for one in family] == [1, 2, 3] * 3 and {one.plant for one in nominal} == {0}
    walls = [one.margins[0, 0] + one.state[0, 0] for one in family]
    assert walls[:3] == pytest.approx(walls[3:6]) and len({round(wall, 6) for wall in walls}) == 3
    assert all(1.0 <= wall <= 3.0 for wall in walls)
    stored = record(9, **drawn, path=tmp_path, num_workers=2)
    for others in (stored, load_episodes(tmp_path)):
        assert_identical(family, others)
        assert [one.plant for one in others] == [1, 2, 3] * 3
    assert len(nominal.joined(family)) == 18
