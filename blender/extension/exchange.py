"""Between Blender's objects and arrays."""

import bpy
import numpy as np

from . import surface
from .errors import ExtensionError

KINDS = {
    "FLOAT": ("value", (), np.float32),
    "INT": ("value", (), np.int32),
    "INT8": ("value", (), np.int32),
    "BOOLEAN": ("value", (), bool),
    "FLOAT2": ("vector", (2,), np.float32),
    "FLOAT_VECTOR": ("vector", (3,), np.float32),
    "FLOAT_COLOR": ("color", (4,), np.float32),
    "BYTE_COLOR": ("color_srgb", (4,), np.float32),
    "QUATERNION": ("value", (4,), np.float32),
    "INT32_2D": ("value", (2,), np.int32),
}
"""Types of attributes: the name, shape and type of their values."""
OWN = ("position", "custom_normal", surface.DISPLACEMENT)
"""Attributes that the result has of its own."""


def column(collection, name, shape=(), kind=np.float32):
    """The values of one property of all members, (members, *shape)."""
    values = np.empty(len(collection) * int(np.prod(shape, dtype=int)), kind)
    collection.foreach_get(name, values)
    return values.reshape(-1, *shape)


def put(collection, name, values):
    """Set one property of all members."""
    collection.foreach_set(name, np.ascontiguousarray(values).ravel())


# ------------------------------------------------------------------------------- to the command


def source_of(thing, group=""):
    """The object's own mesh, without its modifiers, as a `surface.Source`.

    The shape is the basis where there are shape keys. ``group`` is the vertex group for the mask.
    Raises `ExtensionError` if it doesn't exist.
    """
    mesh = thing.data
    mesh.calc_loop_triangles()
    triangles = mesh.loop_triangles
    uv = mesh.uv_layers.active
    return surface.Source(
        basis(mesh),
        column(triangles, "vertices", (3,), np.int32),
        column(triangles, "loops", (3,), np.int32),
        column(triangles, "polygon_index", (), np.int32),
        None if uv is None else column(uv.uv, "vector", (2,)),
        weights(thing, group) if group else None,
        surface.proportions(thing.matrix_world.to_scale()),
    )


def basis(mesh):
    """The vertices (n, 3) without the influence of shape keys."""
    keys = mesh.shape_keys
    return column(keys.reference_key.data if keys else mesh.vertices, "co", (3,))


def weights(thing, name):
    """A vertex group's weights (n,), 0 outside of it."""
    group = thing.vertex_groups.get(name)
    if group is None:
        raise ExtensionError(f"'{thing.name}' has no vertex group '{name}': choose another mask.")
    found = np.zeros(len(thing.data.vertices), np.float32)
    for vertex in thing.data.vertices:
        for member in vertex.groups:
            if member.group == group.index:
                found[vertex.index] = member.weight
    return found


def write_shape(thing, path):
    """Write an object as a style: as it is seen, with its modifiers, in its own frame."""
    evaluated = thing.evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = evaluated.to_mesh()
    mesh.calc_loop_triangles()
    triangles = column(mesh.loop_triangles, "vertices", (3,), np.int32)
    scale = surface.proportions(thing.matrix_world.to_scale())
    points = surface.to_command(column(mesh.vertices, "co", (3,)), scale)
    evaluated.to_mesh_clear()
    if not len(triangles):
        raise ExtensionError(f"the style '{thing.name}' has no faces: choose another object.")
    surface.write_ply(path, dict(zip("xyz", points.T, strict=True)), triangles)


# --------------------------------------------------------------------------------- and back again


def apply(thing, original, source, found, smooth):
    """Give the object a new mesh with the result; its name, transform, modifiers stay.

    ``original`` is kept, with a fake user, for `restore` and for the next run. ``smooth``: shade a
    refined mesh smooth. Returns sentences on what couldn't be kept.
    """
    told = []
    before = thing.data
    active = thing.vertex_groups.active_index
    if isinstance(found, surface.Moved):
        mesh = _moved(before, source, found)
        thing.data = mesh
    else:
        groups = _groups(thing)
        mesh = _refined(before, source, found, smooth)
        thing.data = mesh
        if found.triangle is None:
            told.append("the result is a new surface, without UV maps, groups and attributes")
        else:
            _put_groups(thing, groups, source, found)
            told += _put_keys(thing, before, source, found)
        if len(np.unique(source.triangles)) < len(source.points):
            told.append("vertices and edges without faces were left out")
    if len(thing.vertex_groups):
        thing.vertex_groups.active_index = max(active, 0)
    if not original.use_fake_user:
        original.use_fake_user = original.styleexp_kept = True
    mesh.styleexp_original = original
    if before != original and before.users == 0:
        bpy.data.meshes.remove(before)
    return told


def restore(thing):
    """Give the object its original mesh back."""
    result = thing.data
    original = result.styleexp_original
    thing.data = original
    if original.styleexp_kept:
        original.use_fake_user = original.styleexp_kept = False
    if result.users == 0:
        bpy.data.meshes.remove(result)


def _moved(before, source, found):
    mesh = before.copy()
    mesh.name = _name(before)
    mesh.use_fake_user = mesh.styleexp_kept = False
    if keys := mesh.shape_keys:
        step = found.points - source.points
        for block in keys.key_blocks:
            put(block.data, "co", column(block.data, "co", (3,)) + step)
        put(keys.reference_key.data, "co", found.points)
    put(mesh.vertices, "co", found.points)
    _put_displacement(mesh, found.displacement)
    mesh.update()
    return mesh


def _refined(before, source, found, smooth):
    mesh = bpy.data.meshes.new(_name(before))
    mesh.vertices.add(len(found.points))
    put(mesh.vertices, "co", found.points)
    mesh.loops.add(3 * len(found.faces))
    put(mesh.loops, "vertex_index", found.faces.astype(np.int32))
    mesh.polygons.add(len(found.faces))
    put(mesh.polygons, "loop_start", np.arange(0, 3 * len(found.faces), 3, dtype=np.int32))
    mesh.update(calc_edges=True)
    for material in before.materials:
        mesh.materials.append(material)
    for name in before.keys():  # noqa: SIM118 - custom properties
        mesh[name] = before[name]
    if found.triangle is not None:
        _put_attributes(mesh, before, source, found)
    if smooth:
        put(mesh.polygons, "use_smooth", np.ones(len(mesh.polygons), bool))
    _put_displacement(mesh, found.displacement)
    mesh.update()
    return mesh


def _name(mesh):
    return mesh.name if mesh.styleexp_original else f"{mesh.name} styleexp"


def _put_displacement(mesh, values):
    attribute = mesh.attributes.get(surface.DISPLACEMENT)
    if attribute is not None and (attribute.domain, attribute.data_type) != ("POINT", "FLOAT"):
        mesh.attributes.remove(attribute)
        attribute = None
    if attribute is None:
        attribute = mesh.attributes.new(surface.DISPLACEMENT, "FLOAT", "POINT")
    put(attribute.data, "value", values.astype(np.float32))


def _put_attributes(mesh, before, source, found):
    """UV maps, colours, materials, shading, seams and all other attributes."""
    ends = [column(each.edges, "vertices", (2,), np.int32) for each in (before, mesh)]
    pieces = found.of_edges(source, *ends)
    at = {
        "POINT": lambda values: found.of_vertices(source, values),
        "CORNER": lambda values: found.of_corners(source, values),
        "FACE": lambda values: found.of_faces(source, values),
        # What an edge inside of a polygon has: nothing.
        "EDGE": lambda values: (values[pieces].T * (pieces >= 0)).T.astype(values.dtype),
    }
    for name in [each.name for each in before.attributes]:
        given = before.attributes[name]
        if given.domain not in at or given.data_type not in KINDS or name in OWN:
            continue
        if name.startswith(".") and name != ".uv_seam":  # selections and Blender's own tables
            continue
        values = at[given.domain](column(given.data, *KINDS[given.data_type]))
        made = mesh.attributes.new(name, given.data_type, given.domain)
        put(made.data, KINDS[given.data_type][0], values)
    # Names, because adding an attribute moves the others.
    now, then = mesh.uv_layers, before.uv_layers
    if then.active is not None:
        now.active = now[then.active.name]
        shown = next((each.name for each in then if each.active_render), then.active.name)
        now[shown].active_render = True
    colors = before.color_attributes
    if colors.active_color_name in mesh.color_attributes:
        mesh.color_attributes.active_color_name = colors.active_color_name
    if 0 <= colors.render_color_index < len(colors):
        shown = colors[colors.render_color_index].name
        mesh.color_attributes.render_color_index = mesh.color_attributes.find(shown)


def _groups(thing):
    """Names, locks and weights (vertices,) of an object's vertex groups; NaN outside of them."""
    groups = [(each.name, each.lock_weight) for each in thing.vertex_groups]
    table = np.full((len(groups), len(thing.data.vertices)), np.nan, np.float32)
    for vertex in thing.data.vertices if groups else ():
        for member in vertex.groups:
            table[member.group, vertex.index] = member.weight
    return list(zip(groups, table, strict=True))


def _put_groups(thing, groups, source, found):
    """Interpolate weights; a vertex is in a group where a neighbour of the original is."""
    for (name, locked), values in groups:
        inside = ~np.isnan(values)
        weights = found.of_vertices(source, np.nan_to_num(values))
        members = found.of_vertices(source, inside.astype(np.float32)) > 0
        group = thing.vertex_groups.new(name=name)
        order = np.flatnonzero(members)
        order = order[np.argsort(weights[order], kind="stable")]
        for some in np.split(order, np.flatnonzero(np.diff(weights[order])) + 1):
            if len(some):
                group.add(some.tolist(), float(weights[some[0]]), "REPLACE")
        group.lock_weight = locked


def _put_keys(thing, before, source, found):
    """Shape keys: each moves the new vertices as far as it moved the old ones."""
    keys = before.shape_keys
    if keys is None:
        return []
    for given in keys.key_blocks:
        made = thing.shape_key_add(name=given.name, from_mix=False)
        step = column(given.data, "co", (3,)) - source.points
        put(made.data, "co", found.points + found.of_vertices(source, step))
        for name in ("slider_min", "slider_max", "value", "mute", "vertex_group", "interpolation"):
            setattr(made, name, getattr(given, name))
    made = thing.data.shape_keys
    for given, copy in zip(keys.key_blocks, made.key_blocks, strict=True):
        copy.relative_key = made.key_blocks[given.relative_key.name]
    made.use_relative, made.eval_time = keys.use_relative, keys.eval_time
    if keys.animation_data is not None:
        return ["the shape keys' animation and drivers stay with the original mesh"]
    return []
