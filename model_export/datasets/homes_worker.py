"""Runs inside Blender's own environment: furnished rooms, sharp, with depth, to NPZ files. Not imported by camind.

``python homes_worker.py SPEC.json OUT``. The spec has ``models`` (``path`` of an OBJ file, ``size_m`` as width, depth,
height, ``top_m`` where things stand on it or null), ``pictures`` (paths) and ``rooms`` (``name``, ``seed``, ``views``,
``width_px``, ``height_px``, ``samples``). OUT/NAME_VIEW.npz holds ``light`` float32 [h,w,3], linear, ``depth_m``
float32 [h,w] along the axis, and ``focal_length_px``. A room's floor is z = 0; up is z.
"""

import json
import math
import random
import sys
from pathlib import Path

import bpy
import numpy as np
from blender_worker import depth_of, material, shot, sky, start
from mathutils import Matrix, Vector

SENSOR_MM = 36.0
TRIES = 8
GLIMPSES = (20, 15)
NEAREST_M = 0.2
EMPTY_SHARE = 0.005
OVERVIEW_SHARE, OVERVIEW_M = 0.7, (2.0, 6.0)
THING_M = 0.6  # what is smaller stands on tables
OWN_PAINT_SHARE = 0.8
PAINTED_WALLS = 0.75
PLAIN_SHARE, FAINT_SHARE = 0.4, 0.5
SUNNY_SHARE = 0.35
FAINT = (0.02, 0.3)


def matt(surface, dice):
    """What one sees is where it is: nothing lets light through or mirrors."""
    for name, value in (("Alpha", 1.0), ("Transmission Weight", 0.0), ("Metallic", 0.0)):
        socket = surface.inputs[name]
        for link in list(socket.links):
            surface.id_data.links.remove(link)
        socket.default_value = value
    surface.inputs["Roughness"].default_value = dice.uniform(0.35, 1)


def plain(dice, name):
    made, nodes, links = material(name)
    surface, out = nodes.new("ShaderNodeBsdfPrincipled"), nodes.new("ShaderNodeOutputMaterial")
    links.new(surface.outputs[0], out.inputs["Surface"])
    level = dice.uniform(0.05, 0.85)
    surface.inputs["Base Color"].default_value = (*(level * dice.uniform(0.7, 1) for _ in range(3)), 1)
    matt(surface, dice)
    return made, nodes, links, surface


def lost(node):
    """Whether a node is of a picture that its model came without, which Cycles shows as magenta."""
    return node.type == "TEX_IMAGE" and not (node.image and all(node.image.size))


def pictured(dice, name, size_m, tile_m, pictures, faint=False):
    """A picture laid on from all six sides in tiles of that size, tinted; ``faint``, it hardly shows under paint."""
    made, nodes, links, surface = plain(dice, name)
    place, mapping, image = (nodes.new(f"ShaderNode{kind}") for kind in ("TexCoord", "Mapping", "TexImage"))
    image.image = bpy.data.images.load(dice.choice(pictures), check_existing=True)
    image.projection, image.projection_blend = "BOX", 0.1
    mapping.inputs["Scale"].default_value = [max(size, 1e-3) / tile_m for size in size_m]
    mapping.inputs["Location"].default_value = [dice.random() for _ in range(3)]
    links.new(place.outputs["Generated"], mapping.inputs["Vector"])
    links.new(mapping.outputs[0], image.inputs["Vector"])
    tint = nodes.new("ShaderNodeVectorMath")
    tint.operation = "MULTIPLY"
    tint.inputs[1].default_value = [dice.uniform(0.5, 1) for _ in range(3)]
    links.new(image.outputs["Color"], tint.inputs[0])
    shown = tint.outputs[0]
    if faint:
        mix = nodes.new("ShaderNodeMixRGB")
        mix.inputs["Fac"].default_value = math.exp(dice.uniform(*map(math.log, FAINT)))
        mix.inputs["Color1"].default_value = surface.inputs["Base Color"].default_value
        links.new(shown, mix.inputs["Color2"])
        shown = mix.outputs[0]
    links.new(shown, surface.inputs["Base Color"])
    return made


def sheet(size_m, place, paint, seen_only):
    """A rectangle; one that is ``seen_only`` lets the sky's light in."""
    bpy.ops.mesh.primitive_plane_add(size=1)
    thing = bpy.context.object
    thing.matrix_world = place @ Matrix.Diagonal((*size_m, 1, 1))
    thing.data.materials.append(paint)
    if seen_only:
        thing.visible_shadow = thing.visible_diffuse = False
    return thing


def shell(dice, size, pictures):
    """Floor, ceiling and four walls, with pictures on some."""
    width, depth, height = size

    def paint(name, size_m, plain_share):
        painted = dice.random() < plain_share
        if painted and dice.random() < PLAIN_SHARE:
            return plain(dice, name)[0]
        tile_m = math.exp(dice.uniform(math.log(0.3), math.log(2)))
        return pictured(dice, name, (*size_m, 0), tile_m, pictures, painted)

    sheet((width, depth), Matrix(), paint("floor", (width, depth), 0.15), False)
    above = Matrix.Translation((0, 0, height)) @ Matrix.Rotation(math.pi, 4, "X")
    sheet((width, depth), above, paint("ceiling", (width, depth), 0.8), True)
    wallpaper = dice.random() > PAINTED_WALLS
    for number in range(4):
        long, away = ((width, depth), (depth, width))[number % 2]
        turn = Matrix.Rotation(number * math.pi / 2, 4, "Z") @ Matrix.Translation((0, away / 2, 0))
        upright = turn @ Matrix.Translation((0, 0, height / 2)) @ Matrix.Rotation(math.pi / 2, 4, "X")
        sheet((long, height), upright, paint("wall", (long, height), 0.1 if wallpaper else 0.9), True)
        for hung in range(dice.randint(0, 3)):
            frame = [dice.uniform(0.25, 1.1) for _ in range(2)]
            at = (dice.uniform(-0.42, 0.42) * long, -0.01 - 0.002 * hung, dice.uniform(0.45, 0.75) * height)
            there = turn @ Matrix.Translation(at) @ Matrix.Rotation(math.pi / 2, 4, "X")
            sheet(frame, there, pictured(dice, "hung", (*frame, 0), max(frame), pictures), True)


def bounds(thing):
    corners = [thing.matrix_world @ Vector(corner) for corner in thing.bound_box]
    return (Vector(map(min, zip(*corners, strict=True))), Vector(map(max, zip(*corners, strict=True))))


def furnish(dice, model, at, turn, pictures):
    """A model of its true size, standing at a point; None if it cannot be read."""
    before = set(bpy.data.objects)
    try:
        bpy.ops.wm.obj_import(filepath=model["path"], use_split_objects=False)
    except RuntimeError:
        return None
    found = [thing for thing in bpy.data.objects if thing not in before and thing.type == "MESH"]
    bpy.context.view_layer.update()
    if len(found) != 1:
        return None
    thing = found[0]
    low, high = bounds(thing)
    extent = [max(b - a, 1e-6) for a, b in zip(low, high, strict=True)]
    grow = Matrix.Diagonal((*(size / seen for size, seen in zip(model["size_m"], extent, strict=True)), 1))
    foot = Matrix.Translation((-(low.x + high.x) / 2, -(low.y + high.y) / 2, -low.z))
    thing.matrix_world = Matrix.Translation(at) @ Matrix.Rotation(turn, 4, "Z") @ grow @ foot @ thing.matrix_world
    if dice.random() < OWN_PAINT_SHARE:
        for slot in thing.material_slots:
            nodes = slot.material.node_tree.nodes if slot.material and slot.material.use_nodes else ()
            for node in list(nodes):
                if lost(node):
                    nodes.remove(node)
                elif node.type == "BSDF_PRINCIPLED":
                    matt(node, dice)
        return thing
    for slot in thing.material_slots:
        tile_m = max(model["size_m"]) * math.exp(dice.uniform(math.log(0.15), math.log(1.2)))
        slot.material = pictured(dice, "cover", model["size_m"], tile_m, pictures, dice.random() < FAINT_SHARE)
    return thing


def box(dice, size, at, turn, pictures):
    """A packet, a book."""
    bpy.ops.mesh.primitive_cube_add(size=1)
    thing = bpy.context.object
    thing.matrix_world = (
        Matrix.Translation((at[0], at[1], at[2] + size[2] / 2))
        @ Matrix.Rotation(turn, 4, "Z")
        @ Matrix.Diagonal((*size, 1))
    )
    tile_m = max(size) * dice.uniform(0.4, 1.2)
    thing.data.materials.append(pictured(dice, "packet", size, tile_m, pictures))


def lay(dice, model, at, turn, things, pictures):
    """Things upon a table."""
    for _ in range(dice.randint(3, 10)):
        x, y = (dice.uniform(-0.42, 0.42) * side for side in model["size_m"][:2])
        where = (
            at[0] + x * math.cos(turn) - y * math.sin(turn),
            at[1] + x * math.sin(turn) + y * math.cos(turn),
            at[2] + model["top_m"],
        )
        if dice.random() < 0.35 or not things:
            size = sorted((dice.uniform(0.02, 0.3) for _ in range(3)), key=lambda _: dice.random())
            box(dice, size, where, dice.uniform(0, 6.3), pictures)
        else:
            furnish(dice, dice.choice(things), where, dice.uniform(0, 6.3), pictures)


def furnished(dice, models, pictures):
    """Build the room; the points worth looking at, each with how near one goes to it."""
    size = (dice.uniform(2.5, 7), dice.uniform(2.5, 7), dice.uniform(2.3, 3.2))
    shell(dice, size, pictures)
    things = [model for model in models if max(model["size_m"]) < THING_M]
    large = [model for model in models if max(model["size_m"]) >= THING_M]
    tables = [model for model in large if model["top_m"] and 0.3 < model["top_m"] < 1.2]
    taken, looks = [], []
    for _ in range(dice.randint(10, 24)):
        model = dice.choice(tables if dice.random() < 0.4 and tables else large)
        turn = dice.randrange(4) * math.pi / 2 + dice.gauss(0, 0.1) * (dice.random() < 0.5)
        half = max(model["size_m"][:2]) / 2
        at = [dice.uniform(-0.5, 0.5) * (side - 2 * half) if side > 2 * half else 0.0 for side in size[:2]]
        if dice.random() < 0.6:
            side = dice.randrange(2)
            at[side] = dice.choice((-1, 1)) * max(0.0, size[side] / 2 - model["size_m"][1] / 2 - 0.02)
        near = [math.hypot(at[0] - x, at[1] - y) < 0.7 * (half + other) for x, y, other in taken]
        if any(near) or furnish(dice, model, (*at, 0), turn, pictures) is None:
            continue
        taken.append((*at, half))
        if model["top_m"] and model in tables:
            lay(dice, model, (*at, 0), turn, things, pictures)
            looks.append(((*at, model["top_m"]), (0.35, 1.6)))
        looks.append(((*at, dice.uniform(0.2, 0.9) * model["size_m"][2]), (0.8, 4.5)))
    if not looks:
        looks.append(((0, 0, 1), (1, 3)))
    light(dice, size)
    return size, looks


def light(dice, size):
    for number in range(dice.randint(1, 3)):
        lamp = bpy.data.lights.new(f"lamp{number}", "AREA")
        lamp.size = dice.uniform(0.1, 1.2)
        lamp.energy = dice.uniform(10, 120)
        lamp.color = (1, dice.uniform(0.8, 1), dice.uniform(0.6, 1))
        thing = bpy.data.objects.new(lamp.name, lamp)
        thing.location = (*(dice.uniform(-0.45, 0.45) * side for side in size[:2]), size[2] * dice.uniform(0.7, 0.98))
        thing.rotation_euler = [dice.gauss(0, 0.5), dice.gauss(0, 0.5), 0]
        bpy.context.scene.collection.objects.link(thing)
    if dice.random() < SUNNY_SHARE:
        sun = bpy.data.lights.new("sun", "SUN")
        sun.energy, sun.angle = dice.uniform(1, 6), dice.uniform(0.01, 0.1)
        thing = bpy.data.objects.new(sun.name, sun)
        thing.rotation_euler = [dice.uniform(0.4, 1.3), 0, dice.uniform(0, 6.3)]
        bpy.context.scene.collection.objects.link(thing)
    level = math.exp(dice.uniform(math.log(0.1), math.log(1.0)))
    bpy.context.scene.world = sky([level * dice.uniform(0.85, 1) for _ in range(3)])


def beside(dice, target, reach, size):
    """A point of the room that is about so far from another; close ones are looked down upon."""
    near, far = reach
    away = math.exp(dice.uniform(math.log(near), math.log(far)))
    low, turn = dice.uniform(0.05, 0.9) if far < 2 else dice.uniform(-0.15, 0.5), dice.uniform(0, 6.3)
    step = Vector((math.cos(turn) * math.cos(low), math.sin(turn) * math.cos(low), math.sin(low)))
    eye = target + away * step
    half = [side / 2 - 0.1 for side in size[:2]]
    return Vector((*(max(-h, min(h, v)) for h, v in zip(half, eye, strict=False)), max(0.2, min(size[2] - 0.2, eye.z))))


def stand(dice, scene, size, looks):
    """Put the camera somewhere in the room and have it look at something, at times from as far as the room allows."""
    target, reach = dice.choice(looks)
    target = Vector(target)
    if dice.random() < OVERVIEW_SHARE:
        eye = max((beside(dice, target, OVERVIEW_M, size) for _ in range(TRIES)), key=lambda at: (at - target).length)
    else:
        eye = beside(dice, target, reach, size)
    away = (eye - target).length
    looked = target + 0.15 * away * Vector([dice.gauss(0, 1) for _ in range(3)])
    scene.camera.location = eye
    roll = Matrix.Rotation(dice.gauss(0, 0.05), 4, "Z")
    scene.camera.rotation_euler = ((looked - eye).to_track_quat("-Z", "Y").to_matrix().to_4x4() @ roll).to_euler()
    scene.camera.data.lens = SENSOR_MM * math.exp(dice.uniform(math.log(0.65), math.log(1.6)))


def glimpse(scene):
    """Depths at a few points of the view, 0 where nothing is: a hundredth of what rendering them takes."""
    bpy.context.view_layer.update()
    graph, place = bpy.context.evaluated_depsgraph_get(), scene.camera.matrix_world
    turned, back = place.to_3x3(), place.inverted()
    right, low, _, high = scene.camera.data.view_frame(scene=scene)
    depths = []
    for row in np.linspace(0.03, 0.97, GLIMPSES[1]).tolist():
        for column in np.linspace(0.03, 0.97, GLIMPSES[0]).tolist():
            ray = high + column * (right - high) + row * (low - right)
            hit, at, *_ = scene.ray_cast(graph, place.translation, turned @ ray)
            depths.append(-(back @ at).z if hit else 0.0)
    return np.array(depths)


def is_clear(depth_m):
    """Whether there is something everywhere, and nothing right before the lens."""
    return (depth_m <= 0).mean() < EMPTY_SHARE and np.quantile(depth_m, 0.02) > NEAREST_M


def seen(dice, scene, size, looks):
    """Depth [h,w] of a view with nothing right before the lens; None if none was found."""
    for _ in range(TRIES):
        stand(dice, scene, size, looks)
        if is_clear(glimpse(scene)) and is_clear(depth_m := depth_of(scene)):
            return depth_m
    return None


def main():
    spec, out = json.loads(Path(sys.argv[1]).read_text()), Path(sys.argv[2])
    for room in spec["rooms"]:
        paths = [out / f"{room['name']}_{view}.npz" for view in range(room["views"])]
        dice = random.Random(room["seed"])
        scene = start(
            {
                "seed": room["seed"],
                "size_px": room["width_px"],
                "sensor_width_mm": SENSOR_MM,
                "focal_length_mm": SENSOR_MM,
                "focus_distance_m": 1.0,
                "k_cam_px": 1.0,
            }
        )
        scene.render.resolution_y = room["height_px"]
        scene.cycles.max_bounces, scene.cycles.use_light_tree = 2, False
        scene.cycles.use_denoising, scene.cycles.denoising_quality = True, "FAST"
        scene.cycles.denoiser, scene.cycles.denoising_prefilter = "OPENIMAGEDENOISE", "NONE"
        scene.render.use_persistent_data = True
        size, looks = furnished(dice, spec["models"], spec["pictures"])
        for path in paths:
            depth_m = seen(dice, scene, size, looks)
            if depth_m is not None:
                pixels = shot(scene, room["samples"], False)
                focal_px = scene.camera.data.lens / SENSOR_MM * room["width_px"]
                scratch = path.with_suffix(".part.npz")
                np.savez(scratch, light=pixels, depth_m=depth_m, focal_length_px=focal_px)
                scratch.replace(path)
            sys.stdout.write(f"rendered {path.stem}\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
