"""Stills of the plant of a closed loop by a camera that follows the robot, rendered offscreen."""

import logging
import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    GeometryId,
    LightParameter,
    MakeRenderEngineVtk,
    Mesh,
    RenderCameraCore,
    RenderEngineVtkParams,
    Rgba,
    Role,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.sensors import CameraInfo

from drake_safety.simulation.legged_loop import LeggedLoop

_LOGGER = logging.getLogger("drake_safety")
SUPERSAMPLING = 2  # Rendered pixels for each of a still, in either direction.
_RENDERER = "stills"
_BACKGROUND = [0.80, 0.84, 0.88]
_FIELD_OF_VIEW_RAD = math.radians(34.0)
_PBR_BRIGHTNESS = 2.2  # With a glTF mesh all shading is physically based, which is darker.
_LEAST_GAP_S = 0.3  # Between a still at an event and others.


class StillCamera:
    """A camera that looks at a closed loop's robot from a fixed direction and follows its base.

    It aims by the first of the plant's ``positions`` (N, n_q); the robot is in view in all.
    """

    def __init__(
        self, loop: LeggedLoop, positions: np.ndarray, *, width: int = 720, height: int = 540
    ):
        plant, view = loop.plant, loop.view
        self._plant, self._instance = plant, loop.robot_instance
        self._base = plant.GetBodyByName(loop.robot.base, self._instance)
        self.context = loop.CreateDefaultContext()  # The root Context that is rendered.
        self._plant_context = plant.GetMyMutableContextFromRoot(self.context)
        self._scene_graph = loop.GetSubsystemByName("scene_graph")
        first, *others = np.atleast_2d(positions)
        self._pose(first)
        corners = self._corners()
        centre = 0.5 * (corners.min(axis=1) + corners.max(axis=1))
        radius = float(np.linalg.norm(corners - centre[:, None], axis=0).max())
        base = self._base.EvalPoseInWorld(self._plant_context).translation()
        # Only the horizontal motion of the base is followed, so that a fall remains visible.
        self._look_at_height = centre[2]
        self._offset = (centre - base)[:2]
        farthest = radius
        for one in others:
            self._pose(one)
            away = np.linalg.norm(self._corners() - self._target()[:, None], axis=0)
            farthest = max(farthest, float(away.max()))
        narrow = 0.5 * _FIELD_OF_VIEW_RAD * min(1.0, width / height)
        self._eye = view.room * farthest / math.sin(narrow) * view.direction()
        clipping = ClippingRange(0.05, 30.0 * max(farthest, 1.0))
        info = CameraInfo(width * SUPERSAMPLING, height * SUPERSAMPLING, _FIELD_OF_VIEW_RAD)
        core = RenderCameraCore(_RENDERER, info, clipping, RigidTransform())
        self._camera = ColorRenderCamera(core)
        is_physical = any(path.endswith(".gltf") for path in self._meshes().values())
        self._add_renderer(_lighting(centre, radius, _PBR_BRIGHTNESS if is_physical else 1.0))

    def render(self, positions: np.ndarray) -> np.ndarray:
        """Renders all positions (n_q,) of the plant as RGB, (height, width, 3), uint8."""
        self._pose(positions)
        target = self._target()
        self._X_WC = _look_at(target + self._eye, target)
        world = self._scene_graph.world_frame_id()
        image = self._query().RenderColorImage(self._camera, world, self._X_WC)
        pixels = np.asarray(image.data[..., :3], dtype=np.uint16)
        rows, columns = pixels.shape[0] // SUPERSAMPLING, pixels.shape[1] // SUPERSAMPLING
        blocks = pixels.reshape(rows, SUPERSAMPLING, columns, SUPERSAMPLING, 3)
        return np.round(blocks.mean(axis=(1, 3))).astype(np.uint8)

    def _query(self) -> Any:
        return self._plant.get_geometry_query_input_port().Eval(self._plant_context)

    def _target(self) -> np.ndarray:
        """Point of the world that the camera aims at, (3,)."""
        base = self._base.EvalPoseInWorld(self._plant_context).translation()
        return np.append(base[:2] + self._offset, self._look_at_height)

    def _pose(self, positions: np.ndarray) -> None:
        self._plant.SetPositions(self._plant_context, positions)

    def _add_renderer(self, lighting: RenderEngineVtkParams) -> None:
        """Leaves out meshes that the renderer refuses, such as an OBJ without normals."""
        context = self._scene_graph.GetMyMutableContextFromRoot(self.context)
        try:
            self._scene_graph.AddRenderer(context, _RENDERER, MakeRenderEngineVtk(lighting))
        except RuntimeError as error:
            refused = [mesh for mesh, path in self._meshes().items() if path in str(error)]
            if not refused:
                raise
            _LOGGER.warning("the picture is without a mesh: %s", error)
            source = self._plant.get_source_id()
            for mesh in refused:
                self._scene_graph.RemoveRole(context, source, mesh, Role.kPerception)
            self._scene_graph.RemoveRenderer(context, _RENDERER)
            self._add_renderer(lighting)

    def _meshes(self) -> dict[GeometryId, str]:
        """The files of the scene's meshes."""
        inspector = self._query().inspector()
        shapes = ((i, inspector.GetShape(i)) for i in inspector.GetAllGeometryIds(Role.kPerception))
        return {i: str(one.source().path()) for i, one in shapes if isinstance(one, Mesh)}

    def _corners(self) -> np.ndarray:
        """Corners of boxes around the visible geometry of the robot in the world, (3, N) [m]."""
        inspector = (query := self._query()).inspector()
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1)
        corners = []
        for index in self._plant.GetBodyIndices(self._instance):
            frame = self._plant.GetBodyFrameIdOrThrow(index)
            for geometry in inspector.GetGeometries(frame, Role.kPerception):
                X_WG = query.GetPoseInWorld(geometry)
                if (box := inspector.GetObbInGeometryFrame(geometry)) is None:
                    corners.append(X_WG.translation()[:, None])
                else:
                    corners_B = signs * np.reshape(box.half_width(), (3, 1))
                    corners.append((X_WG @ box.pose()).multiply(corners_B))
        return np.hstack(corners)


def stack_positions(loop: LeggedLoop, states: Mapping[str, np.ndarray]) -> np.ndarray:
    """All positions (N, n_q) of a plant from the logged states (N, n) of its model instances."""
    plant = loop.plant
    instances = map(ModelInstanceIndex, range(plant.num_model_instances()))
    moving = {plant.GetModelInstanceName(i): i for i in instances if plant.num_positions(i)}
    positions = np.zeros((len(next(iter(states.values()))), plant.num_positions()))
    for name, state in states.items():
        columns = plant.GetPositionsFromArray(moving[name], np.arange(plant.num_positions()))
        positions[:, columns.astype(int)] = state[:, : len(columns)]
    return positions


def still_times(
    time_s: np.ndarray, events_s: Iterable[float] = (), *, num_stills: int = 2
) -> list[float]:
    """Logged instants [s] of stills: at events, and at ``num_stills`` other times."""
    kept = [*events_s]
    for instant in np.linspace(time_s[0], time_s[-1], num_stills).tolist():
        if all(abs(instant - event) >= _LEAST_GAP_S for event in kept):
            kept.append(instant)
    return [float(time_s[row]) for row in sorted(set(_nearest_rows(time_s, kept)))]


def render_stills(
    loop: LeggedLoop,
    time_s: np.ndarray,
    positions: np.ndarray,
    still_times_s: Iterable[float],
    *,
    width: int = 720,
    height: int = 540,
) -> list[tuple[float, np.ndarray]]:
    """Logged instants [s] and RGB images (height, width, 3) nearest to the times of stills [s].

    ``positions`` (N, n_q) describe the loop's whole plant.
    """
    rows = _nearest_rows(time_s, still_times_s)
    shown = np.array([positions[row] for row in (0, *rows)])
    camera = StillCamera(loop, shown, width=width, height=height)
    return [(float(time_s[row]), camera.render(positions[row])) for row in rows]


def _nearest_rows(time_s: np.ndarray, instants_s: Iterable[float]) -> list[int]:
    return [int(np.abs(np.asarray(time_s) - instant).argmin()) for instant in instants_s]


def _look_at(p_WC: np.ndarray, p_WT: np.ndarray) -> RigidTransform:
    """Pose of an upright camera at C that looks at T."""
    forward = (p_WT - p_WC) / np.linalg.norm(p_WT - p_WC)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    R_WC = RotationMatrix(np.column_stack([right, np.cross(forward, right), forward]))
    return RigidTransform(R_WC, p_WC)


def _lighting(centre: np.ndarray, radius: float, brightness: float) -> RenderEngineVtkParams:
    """A light that casts shadows and soft fill lights, scaled to the robot."""

    def lamp(x: float, y: float, z: float, intensity: float, kind: str = "point") -> LightParameter:
        offset = np.array([x, y, z]) * radius
        return LightParameter(
            type=kind,
            frame="world",
            position=np.append(centre[:2], 0.0) + offset,
            direction=-offset / np.linalg.norm(offset),
            intensity=brightness * intensity,
            cone_angle=55.0,
            color=Rgba(1.0, 0.99, 0.97, 1.0),
        )

    fill = [(6.0, -8.0, 3.2, 0.42), (-6.0, 8.0, 3.2, 0.42), (6.0, 8.0, 5.0, 0.22)]
    fill += [(-6.0, -8.0, 3.0, 0.22), (0.0, 0.0, 12.0, 0.12)]
    lights = [lamp(2.0, -2.6, 6.8, 0.55, "spot"), *(lamp(*one) for one in fill)]
    shadows: dict[str, Any] = {"cast_shadows": True, "shadow_map_size": 2048}
    return RenderEngineVtkParams(default_clear_color=_BACKGROUND, lights=lights, **shadows)
