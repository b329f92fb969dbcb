"""The panel of a live session: Γ over time, the belief, and the verdict as text.

Meshcat shows geometry, buttons and sliders, but no text and no plots. Text is therefore a picture
on a board, drawn only when it changes; the belief is a bar of three boxes, and Γ a line.
"""

from __future__ import annotations

import base64
import hashlib
import io
import json
import math
from collections import deque
from typing import TYPE_CHECKING

import numpy as np
from pydrake.common import MemoryFile
from pydrake.geometry import InMemoryMesh, Mesh, Meshcat, Rgba
from pydrake.math import RigidTransform, RotationMatrix

from drake_safety.simulation.legged_loop import View

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SAFE_RGB = (0.169, 0.424, 0.690)
UNSAFE_RGB = (0.820, 0.329, 0.106)
UNKNOWN_RGB = (0.788, 0.800, 0.820)
RECOVERY_RGB = (0.106, 0.620, 0.467)
INK_RGB = (0.133, 0.149, 0.169)

_PATH = "/assessment"
_PARTS = ("safe", "unsafe", "unknown")
# Lengths in widths of the board, from its lower edge upwards.
_WIDTH, _MARGIN = 1.0, 0.04
_TEXT_BOARD_HEIGHT = 0.17
_BAR_Z, _BAR_HEIGHT = 0.20, 0.07
_LEGEND_Z = 0.305
_PLOT_Z, _PLOT_HEIGHT = 0.37, 0.34
_TITLE_Z, _HEIGHT = 0.75, 0.79
_LAYER = 0.004  # Between layers of the board.
_PIXELS_PER_UNIT = 700
_TEXT_HEIGHT = 0.034
_HISTORY_S = 6.0
_NUM_BOARDS = 12  # Kept in the scene.
_DPI = 100
_EMPTY = np.array([0.0, 0.0, 1.0])


class LivePanel:
    """A board in the world that faces the camera: text, a bar of the belief, and Γ over time.

    Args:
        meshcat: The Meshcat server.
        view: The camera's pose.
        threshold: Γ at which the curve's threshold line is drawn.
        width_m: Width of the board [m].
    """

    def __init__(self, meshcat: Meshcat, view: View, *, threshold: float, width_m: float):
        self._meshcat = meshcat
        self._view = view
        self._scale = width_m
        self._history: deque[tuple[float, float]] = deque()
        self._text: tuple[str, ...] = ()
        self._boards: list[tuple[object, ...]] = []
        self._belief = np.full(3, np.nan)
        meshcat.Delete(_PATH)
        size = (_WIDTH, _HEIGHT)
        self._put_picture("ground", ground_picture(threshold), size, z=0.0, forward=0.0)
        for name, rgb in zip(_PARTS, (SAFE_RGB, UNSAFE_RGB, UNKNOWN_RGB), strict=True):
            colour = text_picture("", rgb=rgb, ground=rgb, width=0.02, height=0.02)
            self._put_picture(f"belief/{name}/colour", colour, (1.0, _BAR_HEIGHT), z=_BAR_Z)

    def place(self, p_WP: np.ndarray) -> None:
        """Places the board.

        Args:
            p_WP: Middle of its lower edge in the world, (3,) [m].
        """
        turn = RotationMatrix.MakeZRotation(self._view.azimuth_rad + 0.5 * math.pi)
        X_WP = RigidTransform(turn, p_WP).GetAsMatrix4()
        self._meshcat.SetTransform(_PATH, X_WP @ np.diag([self._scale] * 3 + [1.0]))

    def show_text(self, *lines: str, rgb: tuple[float, float, float] = INK_RGB) -> None:
        """Shows text, the first line large; draws only what differs from the text shown.

        Args:
            *lines: At most two lines.
            rgb: Background colour.
        """
        key = (lines, rgb)
        if self._boards and key == self._boards[-1]:
            return
        self._text = lines
        if self._boards:
            self._show_board(self._boards[-1], False)
        if key in self._boards:
            self._boards.remove(key)
        else:
            picture = text_picture(
                *lines, ground=rgb, rgb=(1.0, 1.0, 1.0), width=_WIDTH, height=_TEXT_BOARD_HEIGHT
            )
            self._put_picture(_board_name(key), picture, (_WIDTH, _TEXT_BOARD_HEIGHT), z=0.0)
        self._boards.append(key)
        self._show_board(key, True)
        # A browser fetches a picture some time after it was set: the last few must stay.
        if len(self._boards) > _NUM_BOARDS:
            self._meshcat.Delete(f"{_PATH}/{_board_name(self._boards.pop(0))}")

    def _show_board(self, key: tuple[object, ...], is_visible: bool) -> None:
        self._meshcat.SetProperty(f"{_PATH}/{_board_name(key)}", "visible", is_visible)

    @property
    def text(self) -> tuple[str, ...]:
        """The lines shown."""
        return self._text

    def show_belief(self, belief: np.ndarray) -> None:
        """Shows a belief as a bar of three parts.

        Args:
            belief: (safe, unsafe, don't know), (3,), of sum one; one that is not finite is shown
                as "don't know".
        """
        belief = belief if np.isfinite(belief).all() else _EMPTY
        if np.abs(belief - self._belief).max() < 1e-3:
            return
        self._belief = np.array(belief)
        room = _WIDTH - 2 * _MARGIN
        left = -0.5 * room
        for name, share in zip(_PARTS, belief.tolist(), strict=True):
            share = max(share, 1e-4)  # A transform of zero width has no inverse.
            X = np.diag([share * room, 1.0, 1.0, 1.0])
            X[0, 3] = left + 0.5 * share * room
            self._meshcat.SetTransform(f"{_PATH}/belief/{name}", X)
            left += share * room

    def clear_history(self) -> None:
        """Clears the curve of Γ."""
        self._history.clear()

    def add(self, time_s: float, probability: float) -> None:
        """Appends a point to the curve of Γ.

        Args:
            time_s: Later than the previous point [s].
            probability: Γ, in [0, 1].
        """
        self._history.append((time_s, min(max(probability, 0.0), 1.0)))
        while self._history[0][0] < time_s - _HISTORY_S:
            self._history.popleft()
        if len(self._history) < 2:
            return
        times, values = np.array(self._history).T
        x = 0.5 * _WIDTH - _MARGIN - (time_s - times) / _HISTORY_S * (_WIDTH - 2 * _MARGIN)
        points = np.stack([x, np.full_like(x, -2 * _LAYER), _PLOT_Z + values * _PLOT_HEIGHT])
        self._meshcat.SetLine(f"{_PATH}/curve", points, 4.0, Rgba(*SAFE_RGB))

    def _put_picture(
        self, name: str, png: bytes, size: tuple[float, float], *, z: float, forward: float = 1.0
    ) -> None:
        self._meshcat.SetObject(f"{_PATH}/{name}", Mesh(picture_board(png, *size)))
        self._meshcat.SetTransform(f"{_PATH}/{name}", RigidTransform([0.0, -forward * _LAYER, z]))


def _board_name(key: tuple[object, ...]) -> str:
    """A unique name of the board with this text and colour in the scene tree."""
    return "text/" + hashlib.sha256(repr(key).encode()).hexdigest()[:12]


def ground_picture(threshold: float) -> bytes:
    """The static part of the panel as a PNG: the curve's frame, its threshold, and a legend.

    Args:
        threshold: Γ at which the threshold line is drawn.
    """
    from matplotlib.patches import Rectangle

    figure = _figure(_WIDTH, _HEIGHT, (1.0, 1.0, 1.0))
    points = _TEXT_HEIGHT * _PIXELS_PER_UNIT * 72 / _DPI

    def write(x: float, z: float, text: str, rgb: tuple[float, float, float]) -> None:
        figure.text(x / _WIDTH, z / _HEIGHT, text, size=points, color=rgb, va="center")

    def fill(
        x: float, z: float, width: float, height: float, rgb: tuple[float, float, float]
    ) -> None:
        corner = (x / _WIDTH, z / _HEIGHT)
        patch = Rectangle(corner, width / _WIDTH, height / _HEIGHT, facecolor=rgb, edgecolor="none")
        figure.add_artist(patch)

    room = _WIDTH - 2 * _MARGIN
    write(_MARGIN, _TITLE_Z, f"Γ of the last {_HISTORY_S:g} s, from 0 to 1", INK_RGB)
    fill(_MARGIN, _PLOT_Z, room, _PLOT_HEIGHT, (0.94, 0.945, 0.95))
    level = _PLOT_Z + threshold * _PLOT_HEIGHT
    fill(_MARGIN, level - 0.002, room, 0.004, UNSAFE_RGB)
    write(_MARGIN + 0.01, level - 0.025, f"threshold {threshold:.2f}", UNSAFE_RGB)
    x = _MARGIN
    write(x, _LEGEND_Z, "belief:", INK_RGB)
    places = (0.2, 0.4, 0.64)
    names = ("safe", "unsafe", "don't know")
    for x, name, rgb in zip(places, names, (SAFE_RGB, UNSAFE_RGB, UNKNOWN_RGB), strict=True):
        fill(x, _LEGEND_Z - 0.016, 0.03, 0.03, rgb)
        write(x + 0.045, _LEGEND_Z, name, INK_RGB)
    return _png(figure)


def _figure(width: float, height: float, ground: tuple[float, float, float]) -> Figure:
    from matplotlib.figure import Figure

    size = (width * _PIXELS_PER_UNIT / _DPI, height * _PIXELS_PER_UNIT / _DPI)
    return Figure(figsize=size, dpi=_DPI, facecolor=ground)


def _png(figure: Figure) -> bytes:
    png = io.BytesIO()
    figure.savefig(png, format="png", dpi=_DPI)
    return png.getvalue()


def text_picture(
    *lines: str,
    rgb: tuple[float, float, float],
    ground: tuple[float, float, float],
    width: float,
    height: float,
) -> bytes:
    """Text as a PNG; the first of several lines is bold and larger than the others.

    Args:
        *lines: The text; a line that is too wide is made smaller.
        rgb: Colour of the text.
        ground: Background colour.
        width: Width of the picture, in the board's units.
        height: Height of the picture, in the board's units.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure = _figure(width, height, ground)
    canvas = FigureCanvasAgg(figure)
    width_px, height_px = (_DPI * inches for inches in figure.get_size_inches())
    shares = [1.0] if len(lines) == 1 else [0.56] + [0.44 / (len(lines) - 1)] * (len(lines) - 1)
    top = 1.0
    for i, (line, share) in enumerate(zip(lines, shares, strict=True)):
        points = 0.62 * share * height_px * 72 / _DPI
        text = figure.text(
            0.5,
            top - 0.5 * share,
            line,
            size=points,
            weight="normal" if i else "bold",
            ha="center",
            va="center",
            color=rgb,
            parse_math=False,
        )
        extent_px = text.get_window_extent(canvas.get_renderer()).width
        while extent_px > 0.96 * width_px:  # Hinting keeps small letters from shrinking in step.
            points *= min(0.96 * width_px / extent_px, 0.97)
            text.set_fontsize(points)
            extent_px = text.get_window_extent(canvas.get_renderer()).width
        top -= share
    return _png(figure)


def picture_board(png: bytes, width: float, height: float) -> InMemoryMesh:
    """An unlit rectangle with a picture, as a glTF file in memory.

    The board stands in the x-z plane, centred in x, its lower edge at z = 0, its face towards -y.

    Args:
        png: The picture.
        width: Width of the board.
        height: Height of the board.
    """
    w = 0.5 * width
    # glTF's y is up: Drake turns (x, y, z) into (x, -z, y).
    corners = np.array([(-w, 0, 0), (w, 0, 0), (w, height, 0), (-w, height, 0)], "<f4")
    in_picture = np.array([(0, 1), (1, 1), (1, 0), (0, 0)], "<f4")
    triangles = np.array([0, 1, 2, 0, 2, 3], "<u2")
    parts = [part.tobytes() for part in (corners, in_picture, triangles)]
    starts = np.cumsum([0, *map(len, parts)]).tolist()
    floats, shorts = 5126, 5123  # Component types of glTF.
    primitive = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}
    content = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [
            {
                "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}},
                "alphaMode": "OPAQUE",
                "doubleSided": True,
                "extensions": {"KHR_materials_unlit": {}},
            }
        ],
        "textures": [{"source": 0}],
        "images": [{"uri": _data_uri("image/png", png)}],
        "buffers": [
            {
                "byteLength": starts[-1],
                "uri": _data_uri("application/octet-stream", b"".join(parts)),
            }
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": len(part)}
            for start, part in zip(starts, parts, strict=False)
        ],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": floats,
                "count": 4,
                "type": "VEC3",
                "min": [-w, 0.0, 0.0],
                "max": [w, height, 0.0],
            },
            {"bufferView": 1, "componentType": floats, "count": 4, "type": "VEC2"},
            {"bufferView": 2, "componentType": shorts, "count": 6, "type": "SCALAR"},
        ],
    }
    return InMemoryMesh(mesh_file=MemoryFile(json.dumps(content), ".gltf", "board"))


def _data_uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
