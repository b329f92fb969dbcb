"""A standing robot beside its collision shapes, to see whether they fit."""

from __future__ import annotations

from collections import Counter

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    GeometryInstance,
    Mesh,
    PerceptionProperties,
    Rgba,
    Role,
    Shape,
    Sphere,
)
from pydrake.systems.framework import Context

from drake_safety.evaluation import figure_style as style
from drake_safety.evaluation.stills import StillCamera
from drake_safety.simulation.legged_loop import LeggedLoop

_KINDS: dict[type[Shape], str] = {
    Box: "boxes",
    Sphere: "spheres",
    Capsule: "capsules",
    Cylinder: "cylinders",
    Convex: "convex hulls",
    Ellipsoid: "ellipsoids",
}
_COLOURS = dict(zip(_KINDS.values(), style.SERIES_COLOURS, strict=True))
_SIZE = {"width": 900, "height": 1000}  # Of a still [pixels].
_VISUAL_SHARE = 0.25  # Of the robot's look in the picture of its shapes.


def robot_figure(loop: LeggedLoop) -> Figure:
    """Draws a robot in its standing posture: as it looks, and as it collides."""
    context = loop.CreateDefaultContext()
    loop.reset_to(context, None, loop.standing_start())
    positions = loop.plant.GetPositions(loop.plant.GetMyContextFromRoot(context))
    look = StillCamera(loop, positions, **_SIZE).render(positions)
    camera = StillCamera(loop, positions, **_SIZE)
    kinds = _show_shapes(loop, camera.context)
    shapes = camera.render(positions)
    both = np.round(_VISUAL_SHARE * look + (1 - _VISUAL_SHARE) * shapes).astype(np.uint8)
    with style.drawing_style():
        fig = style.new_figure(9.0, 5.6)
        panels = fig.subplots(1, 2)
        titles = f"{loop.robot.name}, standing", f"{kinds.total()} collision shapes"
        for axes, image, title in zip(panels, (look, both), titles, strict=True):
            axes.imshow(image)
            axes.set_title(title)
            axes.set_axis_off()
        for name in filter(kinds.__contains__, _COLOURS):
            label = f"{name}: {kinds[name]}"
            panels[1].scatter([], [], c=_COLOURS[name], marker="s", label=label)
        box = {"framealpha": 0.8, "frameon": True, "edgecolor": "none"}
        panels[1].legend(loc="upper left", handletextpad=0.2, **box)
    return fig


def _show_shapes(loop: LeggedLoop, context: Context) -> Counter[str]:
    """Shows a robot's collision shapes, coloured by kind, for its visuals, and counts them."""
    plant, scene_graph = loop.plant, loop.GetSubsystemByName("scene_graph")
    source = plant.get_source_id()
    scene_context = scene_graph.GetMyMutableContextFromRoot(context)
    inspector = scene_graph.get_query_output_port().Eval(scene_context).inspector()
    kinds: Counter[str] = Counter()
    for index in plant.GetBodyIndices(loop.robot_instance):
        frame = plant.GetBodyFrameIdOrThrow(index)
        for visual in inspector.GetGeometries(frame, Role.kPerception):
            scene_graph.RemoveRole(scene_context, source, visual, Role.kPerception)
        for shape_id in inspector.GetGeometries(frame, Role.kProximity):
            shape = inspector.GetShape(shape_id)
            if isinstance(shape, Mesh):
                # Drake's contacts are those of its convex hull.
                shape = Convex(shape.source(), shape.scale3())
            kind, name = _KINDS[type(shape)], f"shown {inspector.GetName(shape_id)}"
            kinds[kind] += 1
            shown = GeometryInstance(inspector.GetPoseInFrame(shape_id), shape, name)
            properties = PerceptionProperties()
            properties.AddProperty("phong", "diffuse", Rgba(*to_rgb(_COLOURS[kind])))
            shown.set_perception_properties(properties)
            scene_graph.RegisterGeometry(scene_context, source, frame, shown)
    return kinds
