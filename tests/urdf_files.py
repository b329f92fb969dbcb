"""Small URDF files and meshes, written for a test."""

import numpy as np

LINK = '<link name="{}"><inertial><mass value="1"/>{}</inertial>{}</link>'
_FACES = "".join(f"f {i}//1 {j}//1 {k}//1\n" for i, j, k in ("123", "124", "134", "234"))
TETRAHEDRON = f"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvn 0 0 1\n{_FACES}"
GOOD = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'


def written(folder, *parts, name="r.urdf"):
    """Writes a URDF of some elements; returns its path."""
    path = folder / name
    path.write_text(f'<robot name="r">{"".join(parts)}</robot>')
    return path


def with_shape(text, link, shape):
    """The text of a URDF with one more visual or collision in a link."""
    head, name, tail = text.partition(f'<link name="{link}"')
    assert name
    return head + name + tail.replace("</link>", f"{shape}</link>", 1)


def stl(path, corners):
    """Writes a binary STL of one triangle."""
    facets = np.zeros(1, [("n", "<f4", 3), ("c", "<f4", (3, 3)), ("a", "<u2")])
    facets["c"] = corners
    path.write_bytes(bytes(80) + (1).to_bytes(4, "little") + facets.tobytes())


def mesh(kind, url):
    """A visual or a collision that is a mesh."""
    return f'<{kind}><geometry><mesh filename="{url}"/></geometry></{kind}>'
