import logging

import mujoco
import numpy as np
import pytest
from pydrake.geometry import Mesh
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import (
    AddMultibodyPlantSceneGraph,
    CoulombFriction,
    ExternallyAppliedSpatialForce,
)
from pydrake.systems.framework import DiagramBuilder

import legged_robots
from drake_safety.plants.mujoco_dynamics import MujocoDynamics
from drake_safety.plants.physics import add_ground
from drake_safety.robots.robot import Payload, PlantVariation, add_robot, apply_masses

ROBOTS = ("laikago", "atlas", "hexapod")
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
        self.dynamics = MujocoDynamics(
            self.robot, self.plant, scene_graph, self.variation, time_step_s=STEP_S, servos=servos
        )
        self.model = self.dynamics.model
        self.scratch = mujoco.MjData(self.model)

    def random_state(self, rng, height_m=3.0):
        kinematics = self.kinematics
        quaternion = rng.normal(size=4)
        position = rng.uniform(-1.0, 1.0, 3) + [0.0, 0.0, height_m]
        lowest, highest = kinematics.position_limits.T
        joints = rng.uniform(lowest, highest)
        v = rng.normal(size=kinematics.num_velocities)
        q = np.concatenate([quaternion / np.linalg.norm(quaternion), position, joints])
        return np.concatenate([q, v])

    def forward(self, plant_state):
        """Loads a state into an MjData of the test's own; returns it."""
        state = self.dynamics.state_from(plant_state)
        n_q, n_v = self.model.nq, self.model.nv
        self.scratch.qpos[:], self.scratch.qvel[:] = state[:n_q], state[n_q : n_q + n_v]
        mujoco.mj_forward(self.model, self.scratch)
        return self.scratch


@pytest.fixture(scope="module", params=ROBOTS)
def bench(request):
    return Bench(request.param)


def test_states_come_back_as_they_went(bench):
    rng = np.random.default_rng(0)
    for _ in range(5):
        plant_state = bench.random_state(rng)
        there = bench.dynamics.state_from(plant_state)
        np.testing.assert_allclose(bench.dynamics.plant_state(there), plant_state, atol=1e-14)


def test_a_turn_of_a_rolled_base_is_in_the_body_in_mujoco_and_in_the_world_in_drake():
    bench = Bench("hexapod")
    n_q = bench.model.nq
    plant_state = np.zeros(n_q + bench.model.nv)
    plant_state[:7] = [np.sqrt(0.5), np.sqrt(0.5), 0, 0, 1.0, 2.0, 3.0]  # A quarter turn about x.
    plant_state[n_q : n_q + 6] = [0.0, 0.0, 1.0, 4.0, 5.0, 6.0]  # Turns about the world's z.
    state = bench.dynamics.state_from(plant_state)
    np.testing.assert_allclose(state[:7], [1.0, 2.0, 3.0, np.sqrt(0.5), np.sqrt(0.5), 0, 0])
    # World z is the body's y after a quarter turn about x.
    np.testing.assert_allclose(state[n_q : n_q + 6], [4.0, 5.0, 6.0, 0.0, 1.0, 0.0], atol=1e-15)


def test_masses_are_drakes(bench):
    mass = pytest.approx(bench.kinematics.total_mass, rel=0, abs=1e-8)
    assert bench.model.body_subtreemass[0] == mass


def test_mass_matrix_and_bias_are_drakes_through_the_velocity_conventions(bench):
    plant = bench.kinematics.plant
    context = plant.CreateDefaultContext()
    n_q, n_v = bench.model.nq, bench.model.nv
    rng = np.random.default_rng(1)
    for _ in range(3):
        plant_state = bench.random_state(rng)
        plant.SetPositionsAndVelocities(context, plant_state)
        there = bench.dynamics.state_from(plant_state)

        def in_drake(qvel, there=there):
            state = np.concatenate([there[:n_q], qvel, np.zeros(n_v)])
            return bench.dynamics.plant_state(state)[n_q:]

        T = np.column_stack([in_drake(unit) for unit in np.eye(n_v)])  # v_drake = T qvel.
        data = bench.forward(plant_state)
        M = np.zeros((n_v, n_v))
        mujoco.mj_fullM(bench.model, data, M)
        expected = T.T @ plant.CalcMassMatrix(context) @ T
        np.testing.assert_allclose(M, expected, atol=1e-8)
        # The rate of the angular velocity is one vector in both conventions, so T serves again.
        tau = T.T @ (plant.CalcGravityGeneralizedForces(context) - plant.CalcBiasTerm(context))
        np.testing.assert_allclose(-data.qfrc_bias, tau, atol=1e-8)


def test_feet_are_where_drake_has_them(bench):
    rng = np.random.default_rng(2)
    for _ in range(3):
        plant_state = bench.random_state(rng)
        data = bench.forward(plant_state)
        points = [
            data.body(foot.body).xpos + data.body(foot.body).xmat.reshape(3, 3) @ point
            for foot in bench.robot.feet.values()
            for point in foot.contact_points
        ]
        expected = bench.kinematics.contact_positions(plant_state[: bench.model.nq])
        np.testing.assert_allclose(points, expected, atol=1e-8)


def test_a_robot_that_falls_freely_gains_what_gravity_gives(bench):
    n_q = bench.model.nq
    plant_state = np.concatenate([bench.kinematics.standing_positions(), np.zeros(bench.model.nv)])
    plant_state[6] += 2.0
    plant_state[n_q + 3] = 1.0  # Flies along x.
    state = bench.dynamics.state_from(plant_state)
    command = np.zeros(bench.dynamics.num_command)
    num_steps = 50
    for _ in range(num_steps):
        state = bench.dynamics.step(state, command)
    fallen = bench.dynamics.plant_state(state)
    time_s = num_steps * STEP_S
    # Semi-implicit Euler: v is exact, and the fall g t (t + h) / 2.
    assert fallen[n_q + 5] == pytest.approx(-9.81 * time_s, abs=1e-8)
    assert fallen[4] - plant_state[4] == pytest.approx(time_s, abs=1e-8)
    drop = 0.5 * 9.81 * time_s * (time_s + STEP_S)
    assert plant_state[6] - fallen[6] == pytest.approx(drop, abs=1e-8)
    np.testing.assert_allclose(fallen[7:n_q], plant_state[7:n_q], atol=1e-8)


def test_friction_of_feet_and_everything_else_is_drakes(bench):
    ground = bench.model.geom_bodyid == bench.model.body("WorldModelInstance::world").id
    assert bench.model.geom_friction[ground, 0] == pytest.approx(bench.robot.foot_friction)
    for foot in bench.robot.feet.values():
        of_foot = bench.model.geom_bodyid == bench.model.body(foot.body).id
        is_contact = of_foot & np.isclose(bench.model.geom_size[:, 0], foot.radius_m)
        assert is_contact.sum() == len(foot.contact_points)
        friction = bench.model.geom_friction[is_contact, 0]
        np.testing.assert_allclose(friction, bench.robot.foot_friction)


def test_a_variation_changes_mass_friction_and_damping():
    variation = PlantVariation(mass_scale=1.5, joint_friction_nm=0.4, joint_damping=0.2)
    nominal, varied = Bench("laikago").model, Bench("laikago", variation).model
    np.testing.assert_allclose(varied.body_mass, 1.5 * nominal.body_mass)
    np.testing.assert_allclose(varied.body_inertia, 1.5 * nominal.body_inertia)
    assert varied.body_subtreemass[0] == pytest.approx(1.5 * nominal.body_subtreemass[0])
    np.testing.assert_allclose(varied.dof_frictionloss[6:], 0.4)
    np.testing.assert_allclose(varied.dof_damping[6:], nominal.dof_damping[6:] + 0.2)
    np.testing.assert_array_equal(varied.dof_frictionloss[:6], 0.0)
    np.testing.assert_array_equal(varied.dof_armature, 0.0)


def test_a_payload_weighs_what_it_does_in_drake_however_light_the_robot():
    payload = Payload(mass_kg=4.0, position_m=[0.1, 0.02, 0.08])
    alone = Bench("laikago", PlantVariation(mass_scale=0.8)).model
    loaded = Bench("laikago", PlantVariation(mass_scale=0.8, payload=payload))
    total = loaded.model.body_subtreemass[0]
    assert total == pytest.approx(alone.body_subtreemass[0] + 4.0)
    context = loaded.plant.CreateDefaultContext()
    apply_masses(loaded.plant, context, loaded.robot, loaded.variation)
    plant_state = loaded.random_state(np.random.default_rng(2))
    plant_state[:4] = [1.0, 0.0, 0.0, 0.0]  # Body and world agree: so do both velocities.
    loaded.plant.SetPositionsAndVelocities(context, plant_state)
    data = loaded.forward(plant_state)
    M = np.zeros((loaded.model.nv, loaded.model.nv))
    mujoco.mj_fullM(loaded.model, data, M)
    expected = loaded.plant.CalcMassMatrix(context)
    base = [3, 4, 5, 0, 1, 2]  # Translation first in MuJoCo.
    np.testing.assert_allclose(M[:6, :6], expected[np.ix_(base, base)], atol=1e-8)


def test_stops_and_efforts_are_the_robots(bench):
    joints = [bench.model.joint(name) for name in bench.dynamics.joint_names]
    assert bench.dynamics.joint_names == bench.kinematics.joint_names
    ranges = np.array([joint.range for joint in joints])
    np.testing.assert_allclose(ranges, bench.kinematics.position_limits, atol=1e-12)
    limits = {
        actuator.joint().name(): actuator.effort_limit()
        for actuator in map(bench.plant.get_joint_actuator, bench.plant.GetJointActuatorIndices())
    }
    for joint in joints:
        assert bench.model.jnt_actfrcrange[joint.id, 1] == limits[joint.name]


def test_servos_pull_with_their_gains_until_the_effort_limit():
    bench = Bench("hexapod", servos=True)
    names = bench.dynamics.joint_names
    gains = bench.robot.joint_gains[".*"]
    n_q, n_j = bench.model.nq, len(names)
    plant_state = np.zeros(n_q + bench.model.nv)
    plant_state[0], plant_state[6] = 1.0, 2.0
    data = bench.forward(plant_state)
    command = np.zeros(2 * n_j)
    command[0], command[n_j + 1], command[2] = 0.05, 0.5, 10.0
    for control, place in enumerate(bench.dynamics.command_places):
        data.ctrl[control] = command[place]
    mujoco.mj_forward(bench.model, data)
    forces = [data.qfrc_actuator[bench.model.joint(name).dofadr[0]] for name in names]
    assert forces[0] == pytest.approx(0.05 * gains.stiffness)
    assert forces[1] == pytest.approx(0.5 * gains.damping)
    assert forces[2] == pytest.approx(bench.robot.effort_limits[".*"])
    np.testing.assert_allclose(forces[3:], 0.0, atol=1e-12)


def test_a_force_at_the_centre_of_mass_accelerates_it(bench):
    plant = bench.kinematics.plant
    q = bench.kinematics.standing_positions() + 2.0 * np.eye(bench.model.nq)[6]
    state = bench.dynamics.state_from(np.concatenate([q, np.zeros(bench.model.nv)]))
    command = np.zeros(bench.dynamics.num_command)
    force = ExternallyAppliedSpatialForce()
    force.body_index = bench.plant.GetBodyByName(bench.robot.base).index()
    force.p_BoBq_B = np.array([0.0, 0.1, 0.0])
    force.F_Bq_W = SpatialForce(np.zeros(3), np.array([30.0, 0.0, 0.0]))

    def momentum(state):
        context = plant.CreateDefaultContext()
        plant.SetPositionsAndVelocities(context, bench.dynamics.plant_state(state))
        return plant.CalcSpatialMomentumInWorldAboutPoint(context, np.zeros(3)).translational()

    pushed = bench.dynamics.step(state, command, [force])
    gained = momentum(pushed) - momentum(bench.dynamics.step(state, command))
    np.testing.assert_allclose(gained, [30.0 * STEP_S, 0.0, 0.0], atol=5e-3 * 30 * STEP_S)
    with pytest.raises(ValueError, match="no body 'ground' to push"):
        force.body_index = bench.plant.GetBodyByName("ground").index()
        bench.dynamics.step(state, command, [force])


def test_a_step_from_nothing_finite_or_into_instability_is_an_error(
    bench, caplog, monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)
    good = bench.dynamics.state_from(bench.random_state(np.random.default_rng(3)))
    command = np.zeros(bench.dynamics.num_command)
    bad = good.copy()
    bad[3] = np.nan
    with pytest.raises(RuntimeError, match="cannot step from NaN"):
        bench.dynamics.step(bad, command)
    fast = good.copy()
    fast[bench.model.nq] = 1e12
    before = bench.dynamics.step(good, command)
    with caplog.at_level(logging.DEBUG), pytest.raises(RuntimeError, match="unstable"):
        bench.dynamics.step(fast, command)
    np.testing.assert_array_equal(bench.dynamics.step(good, command), before)
    assert not list(tmp_path.iterdir()), "MuJoCo wrote its log where one happened to be"


def test_what_mujoco_cannot_read_is_refused_by_name(tmp_path):
    robot = legged_robots.load_robot_file(legged_robots.write_hexapod(tmp_path))
    plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), STEP_S)
    add_robot(plant, robot)
    mesh = tmp_path / "mesh.obj"
    mesh.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n")
    body, friction = plant.GetBodyByName("tibia_0"), CoulombFriction(0.5, 0.5)
    plant.RegisterCollisionGeometry(body, RigidTransform(), Mesh(str(mesh)), "mesh", friction)
    plant.Finalize()
    options = {"time_step_s": STEP_S, "servos": False}
    with pytest.raises(ValueError, match=r"body 'tibia_0'.*no collision shape Mesh.*'Sphere'"):
        MujocoDynamics(robot, plant, scene_graph, PlantVariation(), **options)
    robot.urdf = "hexapod.sdf"
    with pytest.raises(ValueError, match=r"robot 'hexapod'.*reads models from URDF files"):
        MujocoDynamics(robot, plant, scene_graph, PlantVariation(), **options)
