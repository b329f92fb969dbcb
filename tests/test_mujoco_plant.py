"""MuJoCo behind the contract: the same robots, tasks and ports, another plant."""

import functools

import mujoco
import numpy as np
import pytest
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, ExternallyAppliedSpatialForce
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

import legged_robots
import reaching_loops
from drake_safety import load_scenario, run_episode
from drake_safety.plants.mujoco_plant import MujocoPlant
from drake_safety.plants.physics import add_ground
from drake_safety.robots.robot import Payload, PlantVariation, add_robot, apply_masses

MUJOCO = PlantVariation(engine="mujoco")
STEP_S = 0.002


class Bench:
    """A robot over the ground as a Drake plant, and the same in MuJoCo."""

    def __init__(self, name, variation=None, servos=False):
        self.robot = legged_robots.robot_model(name)
        self.kinematics = legged_robots.robot_kinematics(name)
        self.variation = variation or PlantVariation()
        self.plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), STEP_S)
        add_robot(self.plant, self.robot, self.variation, scene_graph=scene_graph, servos=servos)
        add_ground(self.plant, self.robot.foot_friction)
        self.plant.Finalize()
        self.system = MujocoPlant(
            self.robot, self.plant, scene_graph, self.variation, time_step_s=STEP_S, servos=servos
        )
        self.model = self.system.model
        self.scratch = mujoco.MjData(self.model)

    def random_state(self, rng):
        quaternion = rng.normal(size=4)
        position = rng.uniform(-1.0, 1.0, 3) + [0.0, 0.0, 3.0]
        joints = rng.uniform(*self.kinematics.position_limits.T)
        q = np.concatenate([quaternion / np.linalg.norm(quaternion), position, joints])
        return np.concatenate([q, rng.normal(size=self.kinematics.num_velocities)])

    def forward(self, plant_state):
        """Loads a state into an MjData of the test's own; returns it."""
        state = self.system.state_from(plant_state)
        n_q, n_v = self.model.nq, self.model.nv
        self.scratch.qpos[:], self.scratch.qvel[:] = state[:n_q], state[n_q : n_q + n_v]
        mujoco.mj_forward(self.model, self.scratch)
        return self.scratch

    def mass_matrix(self, data):
        M = np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, data, M)
        return M


@pytest.fixture(scope="module", params=["atlas", "hexapod"])
def bench(request):
    return Bench(request.param)


@functools.cache
def loop_of(name, variation="mujoco", **options):
    scenario = load_scenario(name)
    scenario.variations = {"nominal": PlantVariation(), "mujoco": MUJOCO}
    scenario.parameters.pushes = {}
    return scenario.make_loop(variation, **options)


def laikago():
    return loop_of("laikago_balancing", ball=False)


def read(loop, context, port="plant_state"):
    return loop.GetOutputPort(port).Eval(context).copy()


def advanced(loop, context, time_s):
    """The state after a simulation of a context that goes on where it stands."""
    simulator = Simulator(loop, context)
    simulator.Initialize()
    simulator.AdvanceTo(context.get_time() + time_s)
    return read(loop, context)


def test_states_are_converted_both_ways(bench):
    plant_state = bench.random_state(np.random.default_rng(0))
    there = bench.system.state_from(plant_state)
    np.testing.assert_allclose(bench.system.plant_state(there), plant_state, atol=1e-14)


def test_mass_matrix_bias_and_feet_are_drakes(bench):
    plant, rng = bench.kinematics.plant, np.random.default_rng(1)
    context = plant.CreateDefaultContext()
    n_q, n_v = bench.model.nq, bench.model.nv
    for _ in range(2):
        plant_state = bench.random_state(rng)
        plant.SetPositionsAndVelocities(context, plant_state)
        there = bench.system.state_from(plant_state)

        def in_drake(qvel, there=there):
            state = np.concatenate([there[:n_q], qvel, np.zeros(n_v)])
            return bench.system.plant_state(state)[n_q:]

        T = np.column_stack([in_drake(unit) for unit in np.eye(n_v)])  # v_drake = T qvel.
        data = bench.forward(plant_state)
        expected = T.T @ plant.CalcMassMatrix(context) @ T
        np.testing.assert_allclose(bench.mass_matrix(data), expected, atol=1e-8)
        # The rate of the angular velocity is one vector in both conventions, so T serves again.
        tau = T.T @ (plant.CalcGravityGeneralizedForces(context) - plant.CalcBiasTerm(context))
        np.testing.assert_allclose(-data.qfrc_bias, tau, atol=1e-8)
        points = [
            data.body(foot.body).xpos + data.body(foot.body).xmat.reshape(3, 3) @ point
            for foot in bench.robot.feet.values()
            for point in foot.contact_points
        ]
        np.testing.assert_allclose(
            points, bench.kinematics.contact_positions(plant_state[:n_q]), atol=1e-8
        )


def test_friction_stops_and_effort_limits_are_drakes(bench):
    model, system = bench.model, bench.system
    ground = model.geom_bodyid == model.body("WorldModelInstance::world").id
    assert model.geom_friction[ground, 0] == pytest.approx(bench.robot.foot_friction)
    assert system.joint_names == bench.kinematics.joint_names
    joints = [model.joint(name) for name in system.joint_names]
    ranges = np.array([joint.range for joint in joints])
    np.testing.assert_allclose(ranges, bench.kinematics.position_limits, atol=1e-12)
    for index in bench.plant.GetJointActuatorIndices():
        actuator = bench.plant.get_joint_actuator(index)
        joint = model.joint(actuator.joint().name())
        assert model.jnt_actfrcrange[joint.id, 1] == actuator.effort_limit()


def test_a_variation_changes_mass_friction_and_damping():
    variation = PlantVariation(mass_scale=1.5, joint_friction_nm=0.4, joint_damping=0.2)
    nominal, varied = Bench("laikago").model, Bench("laikago", variation).model
    np.testing.assert_allclose(varied.body_mass, 1.5 * nominal.body_mass)
    np.testing.assert_allclose(varied.body_inertia, 1.5 * nominal.body_inertia)
    assert varied.body_subtreemass[0] == pytest.approx(1.5 * nominal.body_subtreemass[0])
    np.testing.assert_allclose(varied.dof_frictionloss, [0.0] * 6 + [0.4] * 12)
    np.testing.assert_allclose(varied.dof_damping[6:], nominal.dof_damping[6:] + 0.2)


def test_a_payload_weighs_what_it_does_in_drake_however_light_the_robot():
    payload = Payload(mass_kg=4.0, position_m=[0.1, 0.02, 0.08])
    loaded = Bench("laikago", PlantVariation(mass_scale=0.8, payload=payload))
    context = loaded.plant.CreateDefaultContext()
    apply_masses(loaded.plant, context, loaded.robot, loaded.variation)
    plant_state = loaded.random_state(np.random.default_rng(2))
    plant_state[:4] = [1.0, 0.0, 0.0, 0.0]  # Body and world agree: so do both velocities.
    loaded.plant.SetPositionsAndVelocities(context, plant_state)
    M = loaded.mass_matrix(loaded.forward(plant_state))
    base = [3, 4, 5, 0, 1, 2]  # Translation first in MuJoCo.
    expected = loaded.plant.CalcMassMatrix(context)[np.ix_(base, base)]
    np.testing.assert_allclose(M[:6, :6], expected, atol=1e-8)


def test_servos_pull_with_their_gains_until_the_effort_limit():
    bench = Bench("hexapod", servos=True)
    names, gains = bench.system.joint_names, bench.robot.joint_gains[".*"]
    n_q, n_j = bench.model.nq, len(names)
    plant_state = np.zeros(n_q + bench.model.nv)
    plant_state[0], plant_state[6] = 1.0, 2.0
    data = bench.forward(plant_state)
    command = np.zeros(2 * n_j)
    command[0], command[n_j + 1], command[2] = 0.05, 0.5, 10.0
    data.ctrl[:] = command[bench.system.command_places]
    mujoco.mj_forward(bench.model, data)
    forces = [data.qfrc_actuator[bench.model.joint(name).dofadr[0]] for name in names]
    expected = [0.05 * gains.stiffness, 0.5 * gains.damping, bench.robot.effort_limits[".*"]]
    np.testing.assert_allclose(forces, expected + [0.0] * (n_j - 3), atol=1e-12)


def test_a_force_on_the_base_adds_its_momentum():
    bench = Bench("hexapod")
    plant = bench.kinematics.plant
    q = bench.kinematics.standing_positions() + 2.0 * np.eye(bench.model.nq)[6]
    state = bench.system.state_from(np.concatenate([q, np.zeros(bench.model.nv)]))
    command = np.zeros(bench.system.num_command)
    force = ExternallyAppliedSpatialForce()
    force.body_index = bench.plant.GetBodyByName(bench.robot.base).index()
    force.p_BoBq_B = np.array([0.0, 0.1, 0.0])
    force.F_Bq_W = SpatialForce(np.zeros(3), np.array([30.0, 0.0, 0.0]))

    def momentum(state):
        context = plant.CreateDefaultContext()
        plant.SetPositionsAndVelocities(context, bench.system.plant_state(state))
        return plant.CalcSpatialMomentumInWorldAboutPoint(context, np.zeros(3)).translational()

    pushed = bench.system.step(state, command, [force])
    gained = momentum(pushed) - momentum(bench.system.step(state, command))
    np.testing.assert_allclose(gained, [30.0 * STEP_S, 0.0, 0.0], atol=5e-3 * 30 * STEP_S)


def test_a_step_from_nan_or_into_instability_is_an_error(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    bench = Bench("hexapod")
    good = bench.system.state_from(bench.random_state(np.random.default_rng(3)))
    command = np.zeros(bench.system.num_command)
    bad, fast = good.copy(), good.copy()
    bad[3], fast[bench.model.nq] = np.nan, 1e12
    with pytest.raises(RuntimeError, match="cannot step from NaN"):
        bench.system.step(bad, command)
    before = bench.system.step(good, command)
    with pytest.raises(RuntimeError, match="unstable"):
        bench.system.step(fast, command)
    np.testing.assert_array_equal(bench.system.step(good, command), before)
    assert not list(tmp_path.iterdir()), "MuJoCo wrote its log to the working directory"


def test_two_contexts_of_one_diagram_do_not_disturb_each_other():
    loop = laikago()
    # The starts differ: so do contacts, torques and warm starts.
    alone = [advanced(loop, reaching_loops.started(loop, seed), 0.1) for seed in (0, 1)]
    simulators = [Simulator(loop, reaching_loops.started(loop, seed)) for seed in (0, 1)]
    for simulator in simulators:
        simulator.Initialize()
    for step in range(1, 41):
        for simulator in simulators:
            simulator.AdvanceTo(step * 0.0025)
    for expected, simulator in zip(alone, simulators, strict=True):
        np.testing.assert_array_equal(read(loop, simulator.get_context()), expected)
    context = simulators[0].get_context()
    clone, original = context.Clone(), context.Clone()
    np.testing.assert_array_equal(advanced(loop, clone, 0.05), advanced(loop, original, 0.05))


def test_obstacles_stand_where_the_monitor_has_them_and_stop_an_arm():
    loop = loop_of("atlas_reaching")
    model = loop.GetSubsystemByName("plant").model
    (obstacle,) = loop.scenario.parameters.obstacles
    body = model.body("bookshelf::bookshelf")
    np.testing.assert_allclose(body.pos, obstacle.position)
    boards = model.geom_bodyid == body.id
    np.testing.assert_allclose(model.geom_size[boards], [[0.15, 1.0, 0.025]] * 6)
    # Hands touch boards; feet and ground touch, but not chest and boards, nor hand and ground.
    excluded = {tuple(sorted(divmod(int(code), 1 << 16))) for code in model.exclude_signature}

    def ignore(one, other):
        return tuple(sorted((model.body(one).id, model.body(other).id))) in excluded

    assert not ignore("l_hand", "bookshelf::bookshelf")
    assert ignore("utorso", "bookshelf::bookshelf")
    assert ignore("l_hand", "WorldModelInstance::world")
    assert not ignore("l_foot", "WorldModelInstance::world")


def test_a_robot_of_ones_own_reaches_in_mujoco():
    scenario = load_scenario(reaching_loops.porter_path())
    scenario.variations["nominal"] = MUJOCO
    episode = run_episode(scenario.make_loop(), 0, goal=reaching_loops.EASY)
    assert episode.is_safe
    assert np.linalg.norm(episode.output[-1] - reaching_loops.EASY) < 0.03
    assert episode.num_controller_failures == 0
