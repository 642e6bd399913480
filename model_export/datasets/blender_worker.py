"""Runs inside Blender's own environment: renders the scenes of a JSON file to NPZ files. Not imported by camind.

``python blender_worker.py SCENES.json OUT``. Each scene has ``name``, ``kind`` ("edge" or "room"), ``seed``,
``size_px``, ``focus_distance_m``, ``k_cam_px``, ``focal_length_mm``, ``sensor_width_mm``, ``samples``, and for an
edge ``depth_m``. OUT/NAME.npz holds ``light`` float32 [h,w,3], linear, and ``depth_m`` float32 [h,w] along the axis,
0 where nothing is. The camera stands at the origin and looks along -z.
"""

import json
import math
import random
import sys
import tempfile
from pathlib import Path

import bpy
import numpy as np

DISC_PER_SIGMA = 4.0
EDGE_ANGLE = math.radians(5)


def start(spec):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.use_denoising = False
    scene.cycles.use_adaptive_sampling = False
    scene.cycles.seed = spec["seed"] % 2**31
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = "BOX", 1.0
    scene.render.resolution_x = scene.render.resolution_y = spec["size_px"]
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_depth = "32"
    scene.render.use_persistent_data = False
    scene.render.threads_mode, scene.render.threads = "FIXED", 1  # there is a process for every core
    scene.world = sky((0, 0, 0))
    lens = bpy.data.cameras.new("lens")
    lens.sensor_width = spec["sensor_width_mm"]
    lens.lens = spec["focal_length_mm"]
    lens.clip_start, lens.clip_end = 0.01, 1000
    lens.dof.focus_distance = spec["focus_distance_m"]
    # Cycles' lens: the image plane stands at f, so the disc is A f (1/z - 1/s1), and k_cam = f^2 / (4 N s1 p)
    focal_m, pitch_m = spec["focal_length_mm"] * 1e-3, spec["sensor_width_mm"] * 1e-3 / spec["size_px"]
    lens.dof.aperture_fstop = focal_m**2 / (DISC_PER_SIGMA * spec["k_cam_px"] * spec["focus_distance_m"] * pitch_m)
    lens.dof.aperture_blades = 0
    scene.camera = bpy.data.objects.new("camera", lens)
    scene.collection.objects.link(scene.camera)
    return scene


def sky(color):
    world = bpy.data.worlds.new("sky")
    world.use_nodes = True
    background = next(node for node in world.node_tree.nodes if node.type == "BACKGROUND")
    background.inputs["Color"].default_value = (*color, 1)
    return world


def shot(scene, samples, with_defocus):
    scene.camera.data.dof.use_dof = with_defocus
    scene.cycles.samples = samples
    with tempfile.TemporaryDirectory() as folder:
        scene.render.filepath = str(Path(folder) / "shot.exr")
        bpy.ops.render.render(write_still=True)
        image = bpy.data.images.load(scene.render.filepath)
        width, height = image.size
        pixels = np.empty(width * height * 4, np.float32)
        image.pixels.foreach_get(pixels)
        bpy.data.images.remove(image)
    return pixels.reshape(height, width, 4)[::-1, :, :3].copy()


def material(name):
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    made.node_tree.nodes.clear()
    return made, made.node_tree.nodes, made.node_tree.links


def emitting(name):
    made, nodes, links = material(name)
    glow, out = nodes.new("ShaderNodeEmission"), nodes.new("ShaderNodeOutputMaterial")
    glow.inputs["Strength"].default_value = 1.0
    links.new(glow.outputs[0], out.inputs["Surface"])
    return made, nodes, links, glow


def depth_of(scene):
    made, nodes, links, glow = emitting("depth")
    camera = nodes.new("ShaderNodeCameraData")
    links.new(camera.outputs["View Z Depth"], glow.inputs["Color"])
    layer = scene.view_layers[0]
    layer.material_override = made
    background, scene.world = scene.world, sky((0, 0, 0))
    filter_width, denoised = scene.cycles.filter_width, scene.cycles.use_denoising
    scene.cycles.filter_width, scene.cycles.use_denoising = 0.01, False
    found = shot(scene, 1, False)[..., 0]
    scene.cycles.filter_width, scene.cycles.use_denoising = filter_width, denoised
    layer.material_override, scene.world = None, background
    return found


def slanted_edge(scene, spec):
    """A white half-plane at one depth, its edge through the axis."""
    far = 20 * spec["depth_m"]
    c, s = math.cos(EDGE_ANGLE), math.sin(EDGE_ANGLE)
    corners = [(0, -far), (far, -far), (far, far), (0, far)]
    mesh = bpy.data.meshes.new("edge")
    mesh.from_pydata([(x * c - y * s, x * s + y * c, -spec["depth_m"]) for x, y in corners], [], [(0, 1, 2, 3)])
    mesh.materials.append(emitting("white")[0])
    scene.collection.objects.link(bpy.data.objects.new("edge", mesh))


CONTRASTS = ((0.02, 0.8), (0.8, 0.05), (0.1, 0.4), (0.5, 0.9))
FEATURE_PX = (3, 40)
PATTERNS = (
    ("ShaderNodeTexNoise", {"Detail": (2, 10), "Roughness": (0.5, 0.8)}),
    ("ShaderNodeTexVoronoi", {}),
    ("ShaderNodeTexBrick", {}),
    ("ShaderNodeTexChecker", {}),
    ("ShaderNodeTexWave", {"Distortion": (0, 8), "Detail": (0, 6)}),
    ("ShaderNodeTexMagic", {"Distortion": (0.5, 3)}),
)


def painted(dice, name, unit_px):
    """A matt or glossy material with a pattern of Blender's own between two colours; one in eight is plain.

    ``unit_px`` is how large a unit of the object's own coordinates appears.
    """
    made, nodes, links = material(f"paint {name}")
    surface, out = nodes.new("ShaderNodeBsdfPrincipled"), nodes.new("ShaderNodeOutputMaterial")
    links.new(surface.outputs[0], out.inputs["Surface"])
    surface.inputs["Roughness"].default_value = dice.uniform(0.3, 1)
    colors = [(*(level * (0.5 + dice.random() / 2) for _ in range(3)), 1) for level in dice.choice(CONTRASTS)]
    surface.inputs["Base Color"].default_value = colors[0]
    if dice.random() < 1 / 8:
        return made
    kind, ranges = dice.choice(PATTERNS)
    pattern, place, ramp = nodes.new(kind), nodes.new("ShaderNodeTexCoord"), nodes.new("ShaderNodeValToRGB")
    feature_px = math.exp(dice.uniform(*map(math.log, FEATURE_PX)))
    pattern.inputs["Scale"].default_value = unit_px / feature_px
    for option, (low, high) in ranges.items():
        pattern.inputs[option].default_value = dice.uniform(low, high)
    links.new(place.outputs["Object"], pattern.inputs["Vector"])
    value = next(o for o in pattern.outputs if o.name in ("Fac", "Factor", "Distance") and o.enabled)
    links.new(value, ramp.inputs[0])
    low, high = ramp.color_ramp.elements
    low.color, high.color = colors
    low.position, high.position = 0.3, 0.7
    links.new(ramp.outputs["Color"], surface.inputs["Base Color"])
    return made


SOLIDS = (
    lambda: bpy.ops.mesh.primitive_cube_add(size=1.5),
    lambda: bpy.ops.mesh.primitive_uv_sphere_add(radius=0.8, segments=64, ring_count=32),
    lambda: bpy.ops.mesh.primitive_cone_add(radius1=0.8, depth=1.6, vertices=48),
    lambda: bpy.ops.mesh.primitive_torus_add(major_radius=0.7, minor_radius=0.25),
    lambda: bpy.ops.mesh.primitive_cylinder_add(radius=0.15, depth=3),
    lambda: bpy.ops.mesh.primitive_monkey_add(size=1.5),
)


def room(scene, spec):
    """Solids between half and twice the focus distance over a floor and before a wall, softly lit."""
    dice = random.Random(spec["seed"])
    focus = spec["focus_distance_m"]
    span = spec["sensor_width_mm"] / spec["focal_length_mm"]
    wall = focus * dice.uniform(1.2, 4)
    low = -dice.uniform(0.2, 0.45) * focus * span
    fx_px = spec["size_px"] / span
    bpy.ops.mesh.primitive_plane_add(
        size=40 * wall, location=(0, 0, -wall), rotation=(dice.uniform(-0.3, 0.3), dice.uniform(-0.5, 0.5), 0)
    )
    bpy.context.object.data.materials.append(painted(dice, "wall", fx_px / wall))
    bpy.ops.mesh.primitive_plane_add(
        size=40 * wall, location=(0, low, 0), rotation=(math.pi / 2 + dice.uniform(-0.1, 0.1), 0, 0)
    )
    bpy.context.object.data.materials.append(painted(dice, "floor", fx_px / focus))
    for number in range(dice.randint(3, 14)):
        depth = focus / dice.uniform(1 / 2.5, 2.2)
        size = depth * span * dice.uniform(0.06, 0.3)
        dice.choice(SOLIDS)()
        solid = bpy.context.object
        solid.location = (dice.uniform(-0.5, 0.5) * depth * span, dice.uniform(-0.4, 0.4) * depth * span, -depth)
        solid.rotation_euler = [dice.uniform(0, 6.3) for _ in range(3)]
        solid.scale = (size, size, size * dice.uniform(0.5, 1.5))
        solid.data.materials.append(painted(dice, number, size * fx_px / depth))
        if hasattr(solid.data, "shade_smooth"):
            solid.data.shade_smooth()
    for number in range(dice.randint(1, 3)):
        lamp = bpy.data.lights.new(f"lamp{number}", "AREA")
        lamp.size = focus * dice.uniform(0.1, 1)
        lamp.energy = 40 * focus**2 * dice.uniform(0.5, 2)
        thing = bpy.data.objects.new(lamp.name, lamp)
        thing.location = (dice.uniform(-1, 1) * focus, focus * dice.uniform(0.3, 1.2), focus * dice.uniform(-0.6, 0.3))
        thing.rotation_euler = (dice.uniform(-1.2, -0.2), dice.uniform(-0.6, 0.6), 0)
        scene.collection.objects.link(thing)
    scene.world = sky((0.25, 0.25, 0.28))


def main():
    out = Path(sys.argv[2])
    for spec in json.loads(Path(sys.argv[1]).read_text()):
        path = out / f"{spec['name']}.npz"
        if path.exists():
            continue
        scene = start(spec)
        {"edge": slanted_edge, "room": room}[spec["kind"]](scene, spec)
        light = shot(scene, spec["samples"], True)
        scratch = path.with_suffix(".part.npz")
        np.savez(scratch, light=light, depth_m=depth_of(scene))
        scratch.replace(path)
        sys.stdout.write(f"rendered {spec['name']}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
