"""Figures of Atlas as published, every fixed link by itself.

Source: RobotLocomotion/models, atlas/atlas_minimal_contact.urdf. Left out: four optical frames that
have neither mass nor anything fixed to them, twelve that only repeat the spindle's own, and the
contact points between heel and toe. The standing posture: junhyeokahn/PyPnC,
simulator/pybullet/atlas_dynamics_main.py, with the left elbow's signs inside the limits here.
"""

import math

from published_robots import PublishedRobot, read_fixed, read_joints, read_links

# Mass, centre of mass, and about it ixx iyy izz ixy ixz iyz. All axes are the link's own.
_LINKS = """
pelvis 9.509 0.0111 0 0.0271 0.1244 0.0958 0.1167 0.0008 -0.0007 -0.0005
ltorso 2.27 -0.0112984 -3.15366e-06 0.0746835 0.0039092 0.00341694 0.00174492 -5.04491e-08 -0.000342157 4.87119e-07
mtorso 0.799 -0.00816266 -0.0131245 0.0305974 0.000454181 0.000483282 0.000444215 -6.10764e-05 3.94009e-05 5.27463e-05
utorso 84.409 -0.0622 0.0023 0.3157 1.577 1.602 0.565 -0.032 0.102 0.047
head 1.4199 -0.075493 3.3383e-05 0.02774 0.0039688 0.0041178 0.0035243 -1.5797e-06 -0.00089293 -6.8415e-07
l_uglut 1.959 0.00529262 -0.00344732 0.00313046 0.00074276 0.000688179 0.00041242 -3.79607e-08 -2.79549e-05 -3.2735e-08
l_lglut 0.898 0.0133341 0.0170484 -0.0312052 0.000691326 0.00126856 0.00106487 -2.24344e-05 2.50508e-06 0.000137862
r_uglut 1.959 0.00529262 0.00344732 0.00313046 0.00074276 0.000688179 0.00041242 3.79607e-08 -2.79549e-05 3.2735e-08
r_lglut 0.898 0.0133341 -0.0170484 -0.0312052 0.000691326 0.00126856 0.00106487 2.24344e-05 2.50508e-06 -0.000137862
r_situational_awareness_camera_link 0.1 0 0 0 1e-05 1e-05 1e-05 0 0 0
l_situational_awareness_camera_link 0.1 0 0 0 1e-05 1e-05 1e-05 0 0 0
hokuyo_link 0.057664 0.012428 0.0004084 -0.0041835 3.7174e-05 4.2412e-05 4.167e-05 4.9927e-08 1.1015e-05 -9.8165e-09
head_hokuyo_frame 0.01 0 0 0 1e-05 1e-05 1e-05 0 0 0
left_camera_frame 0.1 0 0 0 0.001 0.001 0.001 0 0 0
right_camera_frame 0.1 0 0 0 0.001 0.001 0.001 0 0 0
center_top_led_frame 0.1 0 0 0 0.001 0.001 0.001 0 0 0
center_bottom_led_frame 0.1 0 0 0 0.001 0.001 0.001 0 0 0
left_led_frame 0.1 0 0 0 0.001 0.001 0.001 0 0 0
right_led_frame 0.1 0 0 0 0.001 0.001 0.001 0 0 0
{0}_clav 4.466 0 0 -0.084 0.011 0.009 0.004 0 0 0.004
{0}_scap 3.899 0 0 0 0.00319 0.00583 0.00583 0 0 0
{0}_uarm 4.386 0 0.065 0 0.00656 0.00358 0.00656 0 0 0
{0}_larm 3.248 0 0 0 0.00265 0.00446 0.00446 0 0 0
{0}_ufarm 2.4798 0.00015 0.08296 0.00037 0.012731 0.002857 0.011948 0 0 0
{0}_lfarm 0.648 0.00017 -0.02515 0.00163 0.000764 0.000429 0.000825 0 0 0
{0}_hand 0.5839 0.00016 -0.08159 2e-05 0.000388 0.000477 0.000379 0 0 0
{0}_uleg 8.204 0 0 -0.21 0.09 0.09 0.02 0 0 0
{0}_lleg 4.515 0.001 0 -0.187 0.077 0.076 0.01 0 -0.003 0
{0}_talus 0.125 0 0 0 1.01674e-05 8.42775e-06 1.30101e-05 0 0 0
{0}_foot 2.41 0.027 0 -0.067 0.002 0.007 0.008 0 0 0
{0}_hand_force_torque 0.1 0 0 0 1e-05 1e-05 1e-05 0 0 0
"""  # noqa: E501

# Parent, child, origin, roll pitch yaw, axis, lower and upper limit, effort, speed, damping.
_JOINTS = """
back_bkz pelvis ltorso -0.0125 0 0 0 0 0 0 0 1 -0.663225 0.663225 106 12 0.1
back_bky ltorso mtorso 0 0 0.162 0 0 0 0 1 0 -0.219388 0.538783 445 9 0.1
back_bkx mtorso utorso 0 0 0.05 0 0 0 1 0 0 -0.523599 0.523599 300 12 0.1
neck_ay utorso head 0.2546 0 0.6215 0 0 0 0 1 0 -0.602139 1.14319 25 6.28 0.1
l_arm_shz utorso l_clav 0.1406 0.2256 0.4776 0 0 3.14159265359 0 0 1 -1.5708 0.785398 87 12 0.1
l_arm_shx l_clav l_scap 0 -0.11 -0.245 0 0 0 -1 0 0 -1.5708 1.5708 99 12 0.1
l_arm_ely l_scap l_uarm 0 -0.187 -0.016 0 0 0 0 -1 0 0 3.14159 63 12 0.1
l_arm_elx l_uarm l_larm 0 -0.119 0.0092 0 0 0 -1 0 0 0 2.35619 112 12 0.1
l_arm_uwy l_larm l_ufarm 0 -0.29955 -0.00921 0 3.14159265359 0 0 -1 0 -3.011 3.011 25 10 0.1
l_arm_mwx l_ufarm l_lfarm 0 0 0 0 0 0 1 0 0 -1.7628 1.7628 25 10 0.1
l_arm_lwy l_lfarm l_hand 0 0 0 0 3.14159265359 0 0 -1 0 -2.9671 2.9671 25 10 0.1
r_arm_shz utorso r_clav 0.1406 -0.2256 0.4776 0 0 0 0 0 1 -0.785398 1.5708 87 12 0.1
r_arm_shx r_clav r_scap 0 -0.11 -0.245 0 0 0 1 0 0 -1.5708 1.5708 99 12 0.1
r_arm_ely r_scap r_uarm 0 -0.187 -0.016 0 0 0 0 1 0 0 3.14159 63 12 0.1
r_arm_elx r_uarm r_larm 0 -0.119 0.0092 0 0 0 1 0 0 -2.35619 0 112 12 0.1
r_arm_uwy r_larm r_ufarm 0 -0.29955 -0.00921 0 0 0 0 1 0 -3.011 3.011 25 10 0.1
r_arm_mwx r_ufarm r_lfarm 0 0 0 0 0 0 1 0 0 -1.7628 1.7628 25 10 0.1
r_arm_lwy r_lfarm r_hand 0 0 0 0 0 0 0 1 0 -2.9671 2.9671 25 10 0.1
l_leg_hpz pelvis l_uglut 0 0.089 0 0 0 0 0 0 1 -0.174358 0.786794 275 12 0.1
r_leg_hpz pelvis r_uglut 0 -0.089 0 0 0 0 0 0 1 -0.786794 0.174358 275 12 0.1
{0}_leg_hpx {0}_uglut {0}_lglut 0 0 0 0 0 0 1 0 0 -0.523599 0.523599 530 12 0.1
{0}_leg_hpy {0}_lglut {0}_uleg 0.05 {1}0.0225 -0.066 0 0 0 0 1 0 -1.61234 0.65764 840 12 0.1
{0}_leg_kny {0}_uleg {0}_lleg -0.05 0 -0.374 0 0 0 0 1 0 0 2.35637 890 12 0.1
{0}_leg_aky {0}_lleg {0}_talus 0 0 -0.422 0 0 0 0 1 0 -1 0.7 740 12 0.1
{0}_leg_akx {0}_talus {0}_foot 0 0 0 0 0 0 1 0 0 -0.8 0.8 360 12 0.1
"""

# Child, parent, origin, roll pitch yaw. Links that are not in the table above have no mass.
_FIXED = """
r_situational_awareness_camera_link utorso 0.155 -0.121 0.785 0 0 -1.309
l_situational_awareness_camera_link utorso 0.155 0.121 0.785 0 0 1.309
pre_spindle head -0.0446 0 0.088 0 0 0
hokuyo_link pre_spindle 0 0 0 0 0 0
head_hokuyo_frame hokuyo_link 0.03 0 0.015 0 0 0
left_camera_frame head 0 0.035 -0.002 0 0 0
right_camera_frame head 0 -0.035 -0.002 0 0 0
center_top_led_frame head 0.01125 0 0.0105 0 0 0
center_bottom_led_frame head 0.01125 0 -0.0155 0 0 0
left_led_frame head -0.01443 0.07452 0.050346 0 -0.15 0.53
right_led_frame head -0.01443 -0.07452 0.050346 0 -0.15 -0.53
l_hand_force_torque l_hand 0 -0.1245 0 0 0 3.141592
r_hand_force_torque r_hand 0 -0.1245 0 0 0 3.141592
"""


def _both(table):
    """The table for the left and the right side, whose places have another sign."""
    return table.format("l", "") + table.format("r", "-")


_QUARTER = math.pi / 4
_SOLE = -0.07645  # Height of the published contact points, which have no radius.

ATLAS = PublishedRobot(
    base="pelvis",
    links=read_links(_both(_LINKS)),
    joints=read_joints(_both(_JOINTS)) | read_fixed(_FIXED),
    total_mass=175.117964,
    posture={
        "l_arm_shx": -_QUARTER,
        "r_arm_shx": _QUARTER,
        "l_arm_ely": 2 * _QUARTER,
        "r_arm_ely": 2 * _QUARTER,
        "l_arm_elx": 2 * _QUARTER,
        "r_arm_elx": -2 * _QUARTER,
        "l_leg_hpy": -_QUARTER,
        "r_leg_hpy": -_QUARTER,
        "l_leg_kny": 2 * _QUARTER,
        "r_leg_kny": 2 * _QUARTER,
        "l_leg_aky": -_QUARTER,
        "r_leg_aky": -_QUARTER,
    },
    standing_height=0.7407,
    standing_height_tolerance=5e-5,
    contact_centres={
        "l_foot": [[x, y, _SOLE + 0.005] for x in (-0.0876, 0.1728) for y in (0.066, -0.0626)],
        "r_foot": [[x, y, _SOLE + 0.005] for x in (-0.0876, 0.1728) for y in (0.0626, -0.066)],
    },
    contact_radius=0.005,  # Ours, and so are the frictions: nothing is published.
    foot_friction=0.8,
    other_friction=0.5,
    partner=(r"l_(.*)", r"r_\1"),
)
