"""URDFs of a quadruped and of a biped's soles, to be changed as exporters change them."""

from itertools import product
from xml.sax.saxutils import quoteattr

LIMIT = '<limit lower="{}" upper="{}" effort="23.7" velocity="30"/>'
CORNERS = ("FL", "FR", "RL", "RR")
STOPS = {"hip": (-0.9, 0.9), "thigh": (-1.0, 3.0), "calf": (-2.7, -0.6)}
FOOT = '<collision><geometry><sphere radius="0.02"/></geometry></collision>'
"""Of the quadruped, on a link that is fixed to the calf."""


def link(name, mass=0.0, shape="", inertia=None, center=(0.0, 0.0, 0.0)):
    """A link with the inertia of a ball of 5 cm, if it has mass."""
    moment = 0.4 * mass * 0.05**2 if inertia is None else inertia
    x, y, z = center
    inertial = (
        f'<inertial><origin xyz="{x} {y} {z}"/><mass value="{mass}"/><inertia ixx="{moment}" '
        f'iyy="{moment}" izz="{moment}" ixy="0" ixz="0" iyz="0"/></inertial>'
    )
    return f"<link name={quoteattr(name)}>{inertial if mass else ''}{shape}</link>"


def joint(name, parent, child, xyz, axis="", inside="", rpy="0 0 0"):
    """A hinge, or a fixed joint without an axis."""
    turns = f'<axis xyz="{axis}"/>{inside}' if axis else ""
    return (
        f'<joint name={quoteattr(name)} type="{"revolute" if axis else "fixed"}">'
        f"<parent link={quoteattr(parent)}/><child link={quoteattr(child)}/>"
        f'<origin xyz="{xyz}" rpy="{rpy}"/>{turns}</joint>'
    )


def box(size, kind="collision", z=0.0):
    """A box as a shape of a link."""
    return f'<{kind}><origin xyz="0 0 {z}"/><geometry><box size="{size}"/></geometry></{kind}>'


def quadruped(root="", above="", foot=FOOT, spelled=lambda name: name):
    """Text of a robot of 8 kg that stands 0.32 m high.

    ``root`` are elements before the trunk and ``above`` elements after the legs; joints and links
    are called ``spelled(name)``, such as ``FL_calf_joint`` and ``FL_calf``.
    """
    trunk = spelled("trunk")
    parts = [root, link(trunk, 4.8, box("0.4 0.2 0.1"), 0.06)]
    for corner, (x, y) in zip(CORNERS, product((0.19, -0.19), (1, -1)), strict=True):
        names = {part: spelled(f"{corner}_{part}") for part in ("hip", "thigh", "calf", "foot")}
        joints = {part: spelled(f"{corner}_{part}_joint") for part in names}
        limits = {part: LIMIT.format(*stops) for part, stops in STOPS.items()}
        parts += [
            link(names["hip"], 0.4),
            link(names["thigh"], 0.24, center=(0, 0, -0.1)),
            link(names["calf"], 0.16, center=(0, 0, -0.1)),
            link(names["foot"], 0.04, foot),
            joint(joints["hip"], trunk, names["hip"], f"{x} {0.05 * y} 0", "1 0 0", limits["hip"]),
            joint(
                joints["thigh"],
                names["hip"],
                names["thigh"],
                f"0 {0.08 * y} 0",
                "0 1 0",
                limits["thigh"],
            ),
            joint(
                joints["calf"], names["thigh"], names["calf"], "0 0 -0.2", "0 1 0", limits["calf"]
            ),
            joint(joints["foot"], names["calf"], names["foot"], "0 0 -0.2"),
        ]
    return f'<robot name="q">{"".join(parts)}{above}</robot>'


def biped(sole):
    """Text of a pelvis on two legs of three joints, whose feet have the shapes ``sole``."""
    parts = [link("pelvis", 10.0, box("0.2 0.2 0.2"), 0.1)]
    for side, y in (("left", 0.1), ("right", -0.1)):
        above = "pelvis"
        for name, z in (("thigh", 0.0), ("shin", -0.3), ("foot", -0.3)):
            parts += [
                link(f"{side}_{name}", 1.0, sole if name == "foot" else ""),
                joint(
                    f"{side}_{name}_joint",
                    above,
                    f"{side}_{name}",
                    f"0 {y if name == 'thigh' else 0} {z}",
                    "0 1 0",
                    LIMIT.format(-2, 2),
                ),
            ]
            above = f"{side}_{name}"
    return f'<robot name="b">{"".join(parts)}</robot>'


def transmissions(*names):
    """Transmissions of ROS 1."""
    return "".join(
        f'<transmission name="{name}_t"><type>transmission_interface/SimpleTransmission</type>'
        f'<joint name="{name}"/><actuator name="{name}_m"/></transmission>'
        for name in names
    )
