"""URDFs of a quadruped and of a biped, to be edited as exporters write them."""

import re
from itertools import product
from xml.sax.saxutils import quoteattr

LIMIT = '<limit lower="{}" upper="{}" effort="23.7" velocity="30"/>'
HIP, THIGH, CALF = (LIMIT.format(*stops) for stops in ((-0.9, 0.9), (-1.0, 3.0), (-2.7, -0.6)))


def shape(form, kind="collision", xyz="0 0 0", rpy="0 0 0"):
    """A shape of a link."""
    return f'<{kind}><origin xyz="{xyz}" rpy="{rpy}"/><geometry><{form}/></geometry></{kind}>'


FOOT = shape('sphere radius="0.02"')
"""Of the quadruped, on a link that is fixed to the calf."""


def link(name, mass=0.0, shapes="", inertia=None):
    """A link; with mass it has the inertia of a ball of 5 cm."""
    moments = 'ixx="{0}" iyy="{0}" izz="{0}"'.format(inertia or 0.4 * mass * 0.05**2)
    inertial = f'<mass value="{mass}"/><inertia {moments} ixy="0" ixz="0" iyz="0"/>'
    inertial = f"<inertial>{inertial}</inertial>" if mass else ""
    return f'<link name="{name}">{inertial}{shapes}</link>'


def joint(name, parent, child, xyz="0 0 0", axis="", inside="", rpy="0 0 0"):
    """A hinge, or a fixed joint without an axis."""
    turns = f'<axis xyz="{axis}"/>{inside}' if axis else ""
    return (
        f'<joint name="{name}" type="{"revolute" if axis else "fixed"}"><parent link="{parent}"/>'
        f'<child link="{child}"/><origin xyz="{xyz}" rpy="{rpy}"/>{turns}</joint>'
    )


def chain(parent, *members):
    """Links below each other: name, mass, shapes, place, and axis and limits of the joint."""
    parts = []
    for name, mass, shapes, *place in members:
        parts += [link(name, mass, shapes), joint(f"{name}_joint", parent, name, *place)]
        parent = name
    return "".join(parts)


def edited(text, edits):
    """The text with pieces replaced, wherever they are."""
    for old, new in edits.items():
        assert old in text
        text = text.replace(old, new)
    return text


def renamed(text, spell):
    """The text with other names of links and joints."""
    name = re.compile('(?<!<robot) (name|link)="([^"]+)"')
    return name.sub(lambda found: f" {found[1]}={quoteattr(spell(found[2]))}", text)


def quadruped(edits=(), root="", above=""):
    """Text of a robot of 8 kg that stands 0.32 m high, with elements before and after it."""
    text = link("trunk", 4.8, shape('box size="0.4 0.2 0.1"'), 0.06)
    for (end, x), (side, y) in product((("F", 0.19), ("R", -0.19)), (("L", 1), ("R", -1))):
        text += chain(
            "trunk",
            (f"{end}{side}_hip", 0.4, "", f"{x} {0.05 * y} 0", "1 0 0", HIP),
            (f"{end}{side}_thigh", 0.24, "", f"0 {0.08 * y} 0", "0 1 0", THIGH),
            (f"{end}{side}_calf", 0.16, "", "0 0 -0.2", "0 1 0", CALF),
            (f"{end}{side}_foot", 0.04, FOOT, "0 0 -0.2"),
        )
    return f'<robot name="q">{root}{edited(text, dict(edits))}{above}</robot>'


def biped(sole):
    """Text of a pelvis on two legs of three joints, whose feet have the shapes ``sole``."""
    text = link("pelvis", 10.0, shape('box size="0.2 0.2 0.2"'), 0.1)
    for side, y in (("left", 0.1), ("right", -0.1)):
        places = ("thigh", "", f"0 {y} 0"), ("shin", "", "0 0 -0.3"), ("foot", sole, "0 0 -0.3")
        hinge = "0 1 0", LIMIT.format(-2, 2)
        text += chain("pelvis", *((f"{side}_{name}", 1.0, *at, *hinge) for name, *at in places))
    return f'<robot name="b">{text}</robot>'
