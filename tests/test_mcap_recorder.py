"""MCAP files of simulations: read by `mcap`, by `read_pieces`, and complete after Ctrl-C."""

import json
import signal

import numpy as np
import pytest
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from command_line import call
from drake_safety import load_assessment, load_scenario
from drake_safety.logs.episodes import cut_log
from drake_safety.logs.mcap_recorder import McapRecorder
from drake_safety.logs.robot_log import read_pieces
from drake_safety.logs.sequences import read_recording
from drake_safety.plants.pushes import Push
from drake_safety.simulation.motion import End, simulate
from drake_safety.simulation.rollouts import episode_rng
from log_files import balancing_loop, recorded, write

pytestmark = pytest.mark.train

SCENARIO, VARIATION, STEP_S = "laikago_balancing", "payload", 0.02
PORTS = ("measured_plant_state", "belief", "margins", "alarm", "alarm_cause", "desired_preview")


def messages(path):
    """Times [s] and decoded messages by topic, and the file's summary."""
    from mcap.reader import make_reader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store, found = get_typestore(Stores.EMPTY), {}
    with path.open("rb") as file:
        reader = make_reader(file)
        for schema in reader.get_summary().schemas.values():
            store.register(get_types_from_msg(schema.data.decode(), schema.name))
        for schema, channel, message in reader.iter_messages():
            times, values = found.setdefault(channel.topic, ([], []))
            times.append(1e-9 * message.log_time)
            values.append(store.deserialize_cdr(message.data, schema.name))
        return found, reader.get_summary()


def numbers(messages):
    """The numbers of messages, (N, n)."""
    names = [name for name in vars(messages[0]) if name != "__msgtype__"]
    return np.array([[getattr(one, name) for name in names] for one in messages])


def record(loop, reset, path, ports, duration_s, monitor=None, **options):
    """Records a motion into a file."""
    with McapRecorder(loop, path, monitor) as recorder:
        return simulate(
            loop,
            lambda context: reset(context, episode_rng(0, 0)),
            ports,
            End(duration_s=duration_s),
            monitor=recorder,
            **options,
        )


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A loop whose plant is not that of training, its motion, and the file of it."""
    scenario = load_scenario(SCENARIO)
    loop = scenario.make_loop(VARIATION, assessment=load_assessment(SCENARIO))
    poses, path = [], tmp_path_factory.mktemp("runs") / "new" / "run.mcap"

    def each_row(context):
        plant = loop.plant
        bodies = [plant.get_body(BodyIndex(i)) for i in range(1, plant.num_bodies())]
        own = plant.GetMyContextFromRoot(context)
        poses.append([plant.EvalBodyPoseInWorld(own, body).translation() for body in bodies])

    motion = record(loop, loop.reset_calm, path, PORTS, 1.0, each_row=each_row)
    return loop, motion, np.array(poses), path


def test_a_file_has_what_the_motion_has_by_names(run):
    loop, motion, poses, path = run
    found, summary = messages(path)
    assert summary.statistics.message_end_time == 1_000_000_000
    for port in ("belief", "margins", "alarm", "desired_preview"):
        times, values = found[f"/{port}"]
        np.testing.assert_allclose(times, motion.time_s)
        np.testing.assert_array_equal(numbers(values), motion[port])
    last = found["/belief"][1][-1]
    assert [last.safe, last.unsafe, last.unknown] == motion["belief"][-1].tolist()
    assert list(vars(found["/margins"][1][0]))[:-1] == loop.constraint_names
    causes = [one.data for one in found["/alarm_cause"][1]]
    assert causes == motion["alarm_cause"].tolist() and "joint" in causes[-1]
    frames = found["/tf"][1]
    places = [[[*vars(t.transform.translation).values()][:3] for t in f.transforms] for f in frames]
    np.testing.assert_allclose(places, poses, atol=1e-9)
    names = [one.child_frame_id for one in frames[0].transforms]
    assert loop.robot.base in names and len(set(names)) == len(names)
    weight = 9.81 * loop.plant.CalcTotalMass(
        loop.plant.CreateDefaultContext(), [loop.robot_instance]
    )
    vertical = numbers(found["/contact_forces"][1])[25:, 2::3].sum(axis=1)
    assert weight < vertical.mean() < 1.4 * weight  # It carries 4 kg.
    assert "fr_calf_joint" in vars(found["/actuation"][1][0])


def test_the_log_reader_needs_no_map(run):
    loop, motion, _, path = run
    read = read_pieces(path, None, loop.robot)
    assert not read.cuts
    (log,) = read.pieces
    measured = motion["measured_plant_state"]
    np.testing.assert_allclose(np.hstack([log.q, log.v]), measured, atol=1e-12)
    np.testing.assert_allclose(log.time_s, motion.time_s, atol=1e-12)
    episodes, _ = cut_log(read.pieces, load_scenario(SCENARIO))
    step = round(0.04 / STEP_S)
    previews = motion["desired_preview"][: step * len(episodes[0].time_s) : step]
    np.testing.assert_allclose(episodes[0].desired_preview, previews, atol=1e-9)


def test_the_command_monitor_gives_the_alarm_of_the_run(run, monkeypatch, tmp_path):
    _, motion, _, path = run
    ((seen_s, _),) = motion.intervals_s("alarm")
    assert not call(monkeypatch, "monitor", SCENARIO, "--log", path, "--out", tmp_path)
    ((alarm,),) = [
        one["alarms"]
        for one in json.loads((tmp_path / "monitor.json").read_text())["entries"]["logs"]
    ]
    # The port shows an alarm in the row after that which raises it.
    assert alarm["begin_s"] == pytest.approx(seen_s - STEP_S)
    assert alarm["cause"] == motion["alarm_cause"][-1]


def test_the_monitor_reads_a_walking_robot_between_pushes(tmp_path):
    scenario, gamma = load_scenario("go2_walking"), load_assessment("go2_walking")
    loop, path = scenario.make_loop(assessment=gamma), tmp_path / "run.mcap"
    push = Push(body="base", time_s=0.5, force_n=[0.0, 20.0, 0.0])

    def start(context):
        loop.reset_undisturbed(context, episode_rng(0, 0), 2.0)
        loop.set_push(context, push)

    with McapRecorder(loop, path) as recorder:
        run = simulate(loop, start, ["levels"], End(duration_s=1.6), monitor=recorder)
    motions, left = read_recording(path, gamma.detector_, gamma.info_)
    assert len(motions) == 2 and not left
    seen, _ = gamma.detector_.watch([rows for _, rows in motions])
    # The port shows levels in the row after.
    after = np.searchsorted(run.time_s, np.concatenate([times for times, _ in motions]) + 0.01)
    np.testing.assert_allclose(seen, run["levels"][after], atol=1e-5)
    with pytest.raises(ValueError, match="which no log has"):
        cut_log(read_pieces(path, None, loop.robot).pieces, loop)


def test_a_log_without_a_map_is_refused(tmp_path, monkeypatch, capsys):
    robot = balancing_loop().robot
    for kind in ("csv", "mcap"):
        with pytest.raises(ValueError, match="has no map of its own"):
            read_pieces(write(recorded(), tmp_path, kind), None, robot)
    np.savez(tmp_path / "run.npz", observations=np.zeros((3, 1)))
    assert call(monkeypatch, "monitor", SCENARIO, "--log", tmp_path / "run.npz") == 2
    assert "need --map" in capsys.readouterr().out


def test_mujoco_has_the_frames_too(tmp_path):
    loop = load_scenario(SCENARIO).make_loop("mujoco", ball=False)
    path = tmp_path / "run.mcap"
    motion = record(loop, loop.reset_calm, path, ["plant_state"], 0.1)
    found, _ = messages(path)
    base = [t for t in found["/tf"][1][-1].transforms if t.child_frame_id == loop.robot.base]
    place = base[0].transform.translation
    np.testing.assert_allclose([place.x, place.y, place.z], motion["plant_state"][-1, 4:7])
    assert "/contact_forces" not in found
    assert len(read_pieces(path, None, loop.robot).pieces[0].time_s) == 6


def test_a_file_is_complete_after_ctrl_c_in_a_simulation(tmp_path):
    scenario = load_scenario("pendulum")
    loop, path = scenario.make_loop(), tmp_path / "run.mcap"

    def stop(context):
        if context.get_time() > 0.5:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        record(loop, loop.reset, path, ["state"], 2.0, stop)
    found, summary = messages(path)
    assert summary.statistics.message_end_time == 500_000_000
    assert {len(times) for times, _ in found.values()} == {26}


def test_any_diagram_is_recorded_and_motions_follow_one_another(tmp_path):
    builder = DiagramBuilder()
    source = builder.AddSystem(ConstantVectorSource([3.0, 4.0]))
    builder.ExportOutput(source.get_output_port(), "value")
    diagram = builder.Build()
    with McapRecorder(diagram, tmp_path / "run.mcap", Context.get_time) as recorder:
        context = diagram.CreateDefaultContext()
        for time_s in (0.0, 0.004, 0.02 - 1e-17, 0.02, 0.1, 0.0, 0.02):
            context.SetTime(time_s)
            assert recorder(context) == time_s
    found, _ = messages(tmp_path / "run.mcap")
    times, values = found["/value"]
    np.testing.assert_allclose(times, [0.0, 0.02, 0.1, 1.1, 1.12])
    assert (values[0].entry_0, values[0].entry_1) == (3.0, 4.0)
