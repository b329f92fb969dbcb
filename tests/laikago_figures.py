"""Figures of Laikago as published, every fixed link by itself.

Source: unitreerobotics/unitree_ros, robots/laikago_description/urdf/laikago.urdf. Left
out: the shoulders' frames, which have no mass.
"""

from published_robots import PublishedRobot, read_fixed, read_joints, read_links

# Mass, centre of mass, and about it ixx iyy izz ixy ixz iyz. All axes are the link's own.
_LINKS = """
trunk 13.733 0.002284 -4.1e-05 0.025165 0.073348887 0.250684593 0.254469458 0.00030338 0.001918218 -7.5402e-05
FR_hip 1.096 -0.001568 0.008134 0.000864 0.000822113 0.000983196 0.000864753 4.982e-06 -3.672e-05 -2.811e-06
FL_hip 1.096 -0.001568 -0.008134 0.000864 0.000822113 0.000983196 0.000864753 -4.982e-06 -3.672e-05 2.811e-06
RR_hip 1.096 0.001568 0.008134 0.000864 0.000822113 0.000983196 0.000864753 -4.982e-06 3.672e-05 -2.811e-06
RL_hip 1.096 0.001568 -0.008134 0.000864 0.000822113 0.000983196 0.000864753 4.982e-06 3.672e-05 2.811e-06
{0}R_thigh 1.528 -0.000482 -0.02001 -0.031996 0.00991611 0.009280083 0.00178256 -1.0388e-05 0.000250428 8.511e-05
{0}R_calf 0.241 -0.002196 -0.000381 -0.12338 0.006181961 0.006196546 3.4774e-05 2.37e-07 -2.985e-06 5.138e-06
{0}R_foot 0.06 0 0 0 1.6854e-05 1.6854e-05 1.6854e-05 0 0 0
{0}L_thigh 1.528 -0.000482 0.02001 -0.031996 0.00991611 0.009280083 0.00178256 1.0388e-05 0.000250428 -8.511e-05
{0}L_calf 0.241 -0.002196 -0.000381 -0.12338 0.006181961 0.006196546 3.4774e-05 2.37e-07 -2.985e-06 5.138e-06
{0}L_foot 0.06 0 0 0 1.6854e-05 1.6854e-05 1.6854e-05 0 0 0
"""  # noqa: E501

# Parent, child, origin, roll pitch yaw, axis, lower and upper limit, effort, speed, damping.
_JOINTS = """
{0}R_hip_joint trunk {0}R_hip {1}0.21935 -0.0875 0 0 0 0 1 0 0 -1.0471975512 0.872664625997 20 52.4 0
{0}R_thigh_joint {0}R_hip {0}R_thigh 0 -0.037 0 0 0 0 0 1 0 -0.523598775598 3.92699081699 55 28.6 0
{0}R_calf_joint {0}R_thigh {0}R_calf 0 0 -0.25 0 0 0 0 1 0 -2.77507351067 -0.610865238198 55 28.6 0
{0}L_hip_joint trunk {0}L_hip {1}0.21935 0.0875 0 0 0 0 1 0 0 -0.872664625997 1.0471975512 20 52.4 0
{0}L_thigh_joint {0}L_hip {0}L_thigh 0 0.037 0 0 0 0 0 1 0 -0.523598775598 3.92699081699 55 28.6 0
{0}L_calf_joint {0}L_thigh {0}L_calf 0 0 -0.25 0 0 0 0 1 0 -2.77507351067 -0.610865238198 55 28.6 0
"""  # noqa: E501

# Child, parent, origin, roll pitch yaw.
_FIXED = """
{0}R_foot {0}R_calf 0 0 -0.25 0 0 0
{0}L_foot {0}L_calf 0 0 -0.25 0 0 0
"""


def _both(table):
    """The table for the front and the rear, whose places have another sign."""
    return table.format("F", "") + table.format("R", "-")


_LEGS = ("FR", "FL", "RR", "RL")

LAIKAGO = PublishedRobot(
    base="trunk",
    links=read_links(_both(_LINKS)),
    joints=read_joints(_both(_JOINTS)) | read_fixed(_both(_FIXED)),
    total_mass=25.433,
    posture={
        f"{leg}_{link}_joint": angle
        for leg in _LEGS
        for link, angle in (("hip", 0.0), ("thigh", 0.67), ("calf", -1.3))
    },
    standing_height=0.4245,
    standing_height_tolerance=1e-3,
    contact_centres={f"{leg}_calf": [[0.0, 0.0, -0.25]] for leg in _LEGS},
    contact_radius=0.0265,
    foot_friction=0.6,  # xacro/gazebo.xacro of the same repository, and so is the other one.
    other_friction=0.2,
    partner=(r"(F|R)L_(.*)", r"\1R_\2"),
)
