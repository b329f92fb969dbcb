"""PolicyController: joint set points from a trained locomotion policy."""

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from drake_safety.control.kinematics import RobotKinematics, is_state
from drake_safety.policies.policy import Policy
from drake_safety.systems.periodic_update import declare_update

ACTING, HELD = 0.0, 1.0
"""Values of ``status``: the network's action, or the last finite one."""


class PolicyController(LeafSystem):
    """Evaluates a policy every period and holds its joint set points.

    .. pydrake_system::

        name: PolicyController
        input_ports: [plant_state: n_q + n_v, command: 3]
        output_ports: [desired_joint_state: 2 n_j, action_state: n_m, status: 1, num_failures: 1,
          memory: n]

    ``command`` is (v_x, v_y, ω_z) in the base's heading frame [m/s, rad/s]. ``memory`` has all that
    a clone needs. ``action_state`` has the last action (n_a,), its largest change in a period (1,),
    sine and cosine of the phases (2 n_p,), and the applied command (3,); the policy may limit its
    change. The last action replaces an action that is not finite; ``status`` is then ``HELD``,
    and ``num_failures`` counts it.
    """

    def __init__(self, kinematics: RobotKinematics, policy: Policy, *, offset_s: float = 0.0):
        super().__init__()
        self.policy = policy
        self._n_q = kinematics.num_positions
        phases = policy.initial_phases
        self._num_actions, self._num_phases = len(policy.joints), len(phases)
        self._state_port = self.DeclareVectorInputPort("plant_state", kinematics.num_states)
        self._command_port = self.DeclareVectorInputPort("command", 3)
        standing = np.append(policy.default_positions, np.zeros(kinematics.num_joints))
        still = [np.zeros(self._num_actions + 1), np.sin(phases), np.cos(phases), np.zeros(3)]
        self._set_point = self.DeclareDiscreteState(standing)
        self._action = self.DeclareDiscreteState(np.concatenate(still))
        self._phases = self.DeclareDiscreteState(phases if self._num_phases else np.zeros(1))
        self._applied = self.DeclareDiscreteState(3)
        self._history = self.DeclareDiscreteState(np.full(policy.num_inputs, np.nan))
        self._memory = self.DeclareDiscreteState(policy.network.initial_memory)
        self._status = self.DeclareDiscreteState([ACTING])  # From here on no memory.
        self._num_failures = self.DeclareDiscreteState(1)
        self.action_names = [
            *(f"action_{name}" for name in policy.joint_names),
            "action_change",
            *(f"{wave}_phase_{i}" for wave in ("sin", "cos") for i in range(self._num_phases)),
            *(f"applied_command_{axis}" for axis in ("forward", "left", "yaw")),
        ]
        declare_update(self, self._update, None, policy.parameters.period_s, offset_s)
        self.DeclareStateOutputPort("desired_joint_state", self._set_point)
        self.DeclareStateOutputPort("action_state", self._action)
        self.DeclareStateOutputPort("status", self._status)
        self.DeclareStateOutputPort("num_failures", self._num_failures)
        self.DeclareVectorOutputPort(
            "memory",
            len(self.state_of(self.CreateDefaultContext())),
            lambda context, output: output.SetFromVector(self.state_of(context)),
            {self.all_state_ticket()},
        )

    def state_of(self, context: Context) -> np.ndarray:
        """The controller's memory in a Context, (n,), for :meth:`set_state`."""
        groups = map(context.get_discrete_state, range(int(self._status)))
        return np.concatenate([group.get_value() for group in groups])

    def set_state(self, context: Context, state: np.ndarray) -> None:
        """Sets the controller's memory to that of :meth:`state_of`."""
        groups = map(context.get_discrete_state, range(int(self._status)))
        ends = np.cumsum([group.size() for group in groups])
        for i, value in enumerate(np.split(state, ends[:-1])):
            context.SetDiscreteState(i, value)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        policy, values = self.policy, context.get_discrete_state()
        action = values.get_value(self._action)[: self._num_actions]
        phases = values.get_value(self._phases)[: self._num_phases]
        applied = values.get_value(self._applied)
        command = self._command_port.Eval(context)
        q, v = np.split(self._state_port.Eval(context), [self._n_q])
        next_action, status = action, HELD
        if is_state(q, v, command):
            applied = policy.next_command(applied, command)
            terms = policy.see(q, v, applied, action, phases)
            observation = policy.observe(terms, values.get_value(self._history))
            proposed, memory = policy.act(observation, values.get_value(self._memory))
            if np.isfinite(proposed).all() and np.isfinite(memory).all():
                next_action, status = proposed, ACTING
                discrete_state.set_value(self._history, observation)
                discrete_state.set_value(self._memory, memory)
        phases = policy.next_phases(phases, applied)
        set_point = np.zeros(2 * len(policy.default_positions))
        set_point[: len(set_point) // 2] = policy.targets(next_action)
        change = float(np.abs(next_action - action).max())
        waves = np.sin(phases), np.cos(phases)
        discrete_state.set_value(self._set_point, set_point)
        action_state = np.concatenate([next_action, [change], *waves, applied])
        discrete_state.set_value(self._action, action_state)
        if self._num_phases:
            discrete_state.set_value(self._phases, phases)
        discrete_state.set_value(self._applied, applied)
        discrete_state.set_value(self._status, [status])
        failures = values.get_value(self._num_failures)
        discrete_state.set_value(self._num_failures, failures + (status == HELD))
