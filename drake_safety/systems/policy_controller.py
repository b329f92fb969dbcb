"""PolicyController: joint set points from a trained locomotion policy."""

from __future__ import annotations

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
        input_ports:
        - plant_state: n_q + n_v
        - command: 3
        output_ports:
        - desired_joint_state: 2 n_j
        - action_state: n_m
        - status: 1
        - num_failures: 1
        - memory: n

    ``command`` is (v_x, v_y, ω_z) in the base's heading frame [m/s, rad/s]. All outputs and the
    memory of a recurrent network are discrete states: a cloned Context continues from its phase of
    the gait, and so does another one that takes over ``memory``. ``action_state`` is the last
    action (n_a,), its largest change in the last period (1,), sine and cosine of the phases
    (2 n_p,), and the command that the policy followed (3,), which differs from the input while the
    policy's change of command is limited. An action that is not finite is replaced by the last one,
    ``status`` is ``HELD``, and ``num_failures`` counts it.
    """

    def __init__(self, kinematics: RobotKinematics, policy: Policy, *, offset_s: float = 0.0):
        super().__init__()
        self.policy = policy
        self._n_q = kinematics.num_positions
        n_a, n_p, n_j = len(policy.joints), len(policy.initial_phases), kinematics.num_joints
        self._state_port = self.DeclareVectorInputPort("plant_state", kinematics.num_states)
        self._command_port = self.DeclareVectorInputPort("command", 3)
        standing = np.concatenate([policy.default_positions, np.zeros(n_j)])
        self._set_point = self.DeclareDiscreteState(standing)
        phases = policy.initial_phases
        memory = np.concatenate([np.zeros(n_a), [0.0], np.sin(phases), np.cos(phases), np.zeros(3)])
        self._action = self.DeclareDiscreteState(memory)
        self._phases = self.DeclareDiscreteState(phases if n_p else np.zeros(1))
        self._applied = self.DeclareDiscreteState(3)
        self._history = self.DeclareDiscreteState(np.full(sum(policy.sizes), np.nan))
        self._memory = self.DeclareDiscreteState(policy.network.initial_memory)
        self._status = self.DeclareDiscreteState([ACTING])  # From here on no memory.
        self._num_failures = self.DeclareDiscreteState(1)
        self.action_names = [
            *(f"action_{name}" for name in policy.joint_names),
            "action_change",
            *(f"{wave}_phase_{i}" for wave in ("sin", "cos") for i in range(n_p)),
            *(f"applied_command_{axis}" for axis in ("forward", "left", "yaw")),
        ]
        self._num_actions, self._num_phases = n_a, n_p
        declare_update(self, self._update, None, policy.parameters.period_s, offset_s)
        self.DeclareStateOutputPort("desired_joint_state", self._set_point)
        self.DeclareStateOutputPort("action_state", self._action)
        self.DeclareStateOutputPort("status", self._status)
        self.DeclareStateOutputPort("num_failures", self._num_failures)
        size = len(self.state_of(self.CreateDefaultContext()))
        self.DeclareVectorOutputPort(
            "memory",
            size,
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
        policy, n_a = self.policy, self._num_actions
        action = context.get_discrete_state(self._action).get_value()[:n_a]
        phases = context.get_discrete_state(self._phases).get_value()[: self._num_phases]
        applied = context.get_discrete_state(self._applied).get_value()
        wanted = self._command_port.Eval(context)
        plant_state = self._state_port.Eval(context)
        new, status = action, HELD
        q, v = plant_state[: self._n_q], plant_state[self._n_q :]
        if is_state(q, v, wanted):
            applied = policy.next_command(applied, wanted)
            seen = policy.see(q, v, applied, action, phases)
            history = context.get_discrete_state(self._history).get_value()
            observation = policy.observe(seen, history)
            memory = context.get_discrete_state(self._memory).get_value()
            found, memory = policy.act(observation, memory)
            if np.isfinite(found).all() and np.isfinite(memory).all():
                new, status = found, ACTING
                discrete_state.set_value(self._history, observation)
                discrete_state.set_value(self._memory, memory)
        phases = policy.next_phases(phases, applied)
        set_point = np.zeros(2 * len(policy.default_positions))
        set_point[: len(set_point) // 2] = policy.targets(new)
        change = float(np.abs(new - action).max())
        memory = np.concatenate([new, [change], np.sin(phases), np.cos(phases), applied])
        discrete_state.set_value(self._set_point, set_point)
        discrete_state.set_value(self._action, memory)
        if self._num_phases:
            discrete_state.set_value(self._phases, phases)
        discrete_state.set_value(self._applied, applied)
        discrete_state.set_value(self._status, [status])
        failures = context.get_discrete_state(self._num_failures).get_value()
        discrete_state.set_value(self._num_failures, failures + (status == HELD))
