"""Reads of the scene's arrays without Warp's test of an index for its sign, which took 3 % of the time of an image.

Reads are word by word: a load of two or more words at a time would keep loops over lanes from becoming SIMD
(``lanes.py``).
"""

import warp as wp

from warp_psdr.kernels.structs import Bsdf, Emitter, Scene, Shape, Texture, Triangle


# Warp takes the types from the functions' bodies; the snippets are what runs.
@wp.func_native("return values.data[offset];")
def load_float(values: wp.array(dtype=wp.float32), offset: wp.int32) -> wp.float32:
    return wp.float32(0.0)


@wp.func_native("return numbers.data[index];")
def load_int(numbers: wp.array(dtype=wp.int32), index: wp.int32) -> wp.int32:
    return wp.int32(0)


@wp.func_native("return ((const float*)(triangles.data + face))[word];")
def triangle_float(triangles: wp.array(dtype=Triangle), face: wp.int32, word: wp.int32) -> wp.float32:
    return wp.float32(0.0)


@wp.func_native("return ((const int*)(triangles.data + face))[word];")
def triangle_int(triangles: wp.array(dtype=Triangle), face: wp.int32, word: wp.int32) -> wp.int32:
    return wp.int32(0)


def reader(record) -> wp.Function:
    """Return ``load(records, i) -> record`` for arrays of a Warp struct without vectors."""

    def load(records: wp.array(dtype=record), i: wp.int32) -> record:
        return record()

    load.__qualname__ = load.__name__ = f"load_{record.key.rsplit('.', 1)[-1].lower()}"
    fields = "".join(f"r.{name} = records.data[i].{name};\n" for name in record.vars)
    return wp.func_native(f"{record.native_name} r;\n{fields}return r;")(load)


LOAD_SHAPE, LOAD_BSDF, LOAD_TEXTURE, LOAD_EMITTER = (reader(record) for record in (Shape, Bsdf, Texture, Emitter))


@wp.func
def load_vec2(values: wp.array(dtype=wp.float32), offset: wp.int32) -> wp.vec2:
    return wp.vec2(load_float(values, offset), load_float(values, offset + 1))


@wp.func
def load_vec3(values: wp.array(dtype=wp.float32), offset: wp.int32) -> wp.vec3:
    return wp.vec3(load_float(values, offset), load_float(values, offset + 1), load_float(values, offset + 2))


@wp.func
def triangle_vec3(triangles: wp.array(dtype=Triangle), face: wp.int32, word: wp.int32) -> wp.vec3:
    return wp.vec3(
        triangle_float(triangles, face, word),
        triangle_float(triangles, face, word + 1),
        triangle_float(triangles, face, word + 2),
    )


@wp.func
def triangle_at(scene: Scene, face: wp.int32) -> Triangle:
    tri = Triangle()
    tri.p0 = triangle_vec3(scene.triangles, face, 0)
    tri.p1 = triangle_vec3(scene.triangles, face, 3)
    tri.p2 = triangle_vec3(scene.triangles, face, 6)
    tri.normal = triangle_vec3(scene.triangles, face, 9)
    tri.i0 = triangle_int(scene.triangles, face, 12)
    tri.i1 = triangle_int(scene.triangles, face, 13)
    tri.i2 = triangle_int(scene.triangles, face, 14)
    tri.shape = triangle_int(scene.triangles, face, 15)
    return tri


@wp.func
def shape_at(scene: Scene, index: wp.int32) -> Shape:
    return LOAD_SHAPE(scene.shapes, index)


@wp.func
def bsdf_at(scene: Scene, index: wp.int32) -> Bsdf:
    return LOAD_BSDF(scene.bsdfs, index)


@wp.func
def texture_record(scene: Scene, index: wp.int32) -> Texture:
    return LOAD_TEXTURE(scene.textures, index)


@wp.func
def emitter_at(scene: Scene, index: wp.int32) -> Emitter:
    return LOAD_EMITTER(scene.emitters, index)
