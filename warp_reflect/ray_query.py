"""What a ray meets: the only place that asks the structure over a scene's triangles for one ray, but for some branch of it.

On a CPU Warp's own query answers, down Warp's tree. On CUDA the same tree is walked in the layout of `ray_tree.py`: a node's
four children are asked at once, nearest first, and a triangle's corners lie where they are read. A thread waits less for
memory, and needs few enough registers for others to work meanwhile. The walk is plain C++, which tests run on a CPU
(`first_walked`, `any_walked`).

The test of a triangle is Warp's: edges that triangles share are decided alike by both, no ray goes between them. Boxes are
larger than what is in them (`ray_tree.fit_element`), by more than the rounding here: no ray goes past one by that either.

Sources: Woop, Benthin and Wald, Watertight Ray/Triangle Intersection, JCGT 2 (1), 2013; Ylitie, Karras and Laine, Efficient
Incoherent Ray Traversal on GPUs Through Compressed Wide BVHs, HPG 2017 (children's boxes in bytes); Ize, Robust BVH Ray
Traversal, JCGT 2 (2), 2013 (ends of intervals widened by their rounding).
"""

from __future__ import annotations

import warp as wp

from warp_reflect.ray_tree import STACK

wp.set_module_options({"enable_backward": False})

# Needs: handle, origin, direction, reach. FOUND is what is done at the first hit.
_WALK = r"""
#if defined(__CUDA_ARCH__)
    typedef uint4 Words;
    auto load = [](const void* from, int at) -> Words { return __ldg((const uint4*)from + at); };
    auto real = [](unsigned word) -> float { return __uint_as_float(word); };
    auto bits = [](float number) -> unsigned { return __float_as_uint(number); };
    // 32768 plus a byte of a word, in one instruction.
    auto byte_of = [&](unsigned word, unsigned k) -> float { return real(__byte_perm(word, 0x47000000u, 0x7404u | k << 4)); };
    auto lesser = [](float a, float b) -> float { return fminf(a, b); };
    auto larger = [](float a, float b) -> float { return fmaxf(a, b); };
#else
    struct Words { unsigned x, y, z, w; };
    auto load = [](const void* from, int at) -> Words { return ((const Words*)from)[at]; };
    union Both { unsigned word; float number; };
    auto real = [](unsigned word) -> float { Both both; both.word = word; return both.number; };
    auto bits = [](float number) -> unsigned { Both both; both.number = number; return both.word; };
    auto byte_of = [&](unsigned word, unsigned k) -> float { return real(0x47000000u | (word >> 8 * k & 255u) << 8); };
    auto lesser = [](float a, float b) -> float { return a < b ? a : b; };
    auto larger = [](float a, float b) -> float { return a > b ? a : b; };
#endif
    const void* nodes = ((const void* const*)handle)[0];
    const void* triangles = ((const void* const*)handle)[1];
    const float px = origin[0], py = origin[1], pz = origin[2];
    // So far along an axis that what a ray does not move on it stays finite, and beside what it does move is nothing.
    auto inverse = [](float d) -> float { return 1.0f / ((d < 0.0f ? -d : d) > 1.0e-15f ? d : 1.0e-15f); };
    const float ix = inverse(direction[0]), iy = inverse(direction[1]), iz = inverse(direction[2]);
    // Axes in turn until the last is the one that the ray goes along most; sheared, the ray goes along it only.
    const float ax = wp::abs(direction[0]), ay = wp::abs(direction[1]), az = wp::abs(direction[2]);
    const bool along_x = ax >= ay && ax >= az, along_y = !along_x && ay >= az;
    const float inverse_along = along_x ? ix : along_y ? iy : iz;
    const float shear_x = inverse_along * (along_x ? direction[1] : along_y ? direction[2] : direction[0]);
    const float shear_y = inverse_along * (along_x ? direction[2] : along_y ? direction[0] : direction[1]);
    struct Corner { float x, y, z; };
    auto seen = [&](const Words& corner) -> Corner {
        const float x = real(corner.x) - px, y = real(corner.y) - py, z = real(corner.z) - pz;
        const float along = along_x ? x : along_y ? y : z;
        const float across = along_x ? y : along_y ? z : x, up = along_x ? z : along_y ? x : y;
        return Corner{across - shear_x * along, up - shear_y * along, along};
    };
    float best_t = reach, best_u = 0.0f, best_v = 0.0f;
    unsigned best = 0u;
    constexpr int END = (int)0x80000000;
    int stack[STACK], size = 1, current = 0;
    stack[0] = END;
    while (current != END) {
        if (current >= 0) {
            const Words frame = load(nodes, 4 * current), children = load(nodes, 4 * current + 1);
            const Words low = load(nodes, 4 * current + 2), high = load(nodes, 4 * current + 3);
            const float sx = real((frame.w & 255u) << 23) * ix, sy = real((frame.w >> 8 & 255u) << 23) * iy;
            const float sz = real((frame.w >> 16) << 23) * iz;
            const float ox = (real(frame.x) - px) * ix - 32768.0f * sx, oy = (real(frame.y) - py) * iy - 32768.0f * sy;
            const float oz = (real(frame.z) - pz) * iz - 32768.0f * sz;
            const unsigned in_x = ix < 0.0f ? high.x : low.x, out_x = ix < 0.0f ? low.x : high.x;
            const unsigned in_y = iy < 0.0f ? high.y : low.y, out_y = iy < 0.0f ? low.y : high.y;
            const unsigned in_z = iz < 0.0f ? high.z : low.z, out_z = iz < 0.0f ? low.z : high.z;
            // Where the ray enters a child, its last two bits the child's number: distances are ordered as their bits are.
            constexpr unsigned PAST = ~0u;
            auto entry = [&](unsigned k) -> unsigned {
                const float in = larger(larger(byte_of(in_x, k) * sx + ox, byte_of(in_y, k) * sy + oy),
                                        larger(byte_of(in_z, k) * sz + oz, 0.0f));
                const float out = lesser(lesser(byte_of(out_x, k) * sx + ox, byte_of(out_y, k) * sy + oy),
                                         lesser(byte_of(out_z, k) * sz + oz, best_t));
                return in <= out * 1.0000005f ? (bits(in) & ~3u) | k : PAST;
            };
            unsigned a = entry(0u), b = entry(1u), c = entry(2u), d = entry(3u);
            auto order = [](unsigned& one, unsigned& other) {
                const unsigned less = one < other ? one : other;
                other = one < other ? other : one;
                one = less;
            };
            order(a, b); order(c, d); order(a, c); order(b, d); order(b, c);
            auto child = [&](unsigned key) -> int {
                return key & 2u ? (key & 1u ? children.w : children.z) : (key & 1u ? children.y : children.x);
            };
            if (d != PAST) stack[size++] = child(d);
            if (c != PAST) stack[size++] = child(c);
            if (b != PAST) stack[size++] = child(b);
            current = a != PAST ? child(a) : stack[--size];
        }
        // Not `else`: who has come to a leaf goes on with those that wait at one.
        if (current < 0 && current != END) {
            int at = 3 * ~current;
            bool last;
            do {
                const Words first = load(triangles, at), second = load(triangles, at + 1), third = load(triangles, at + 2);
                at += 3;
                last = first.w & 1u;
                const Corner a = seen(first), b = seen(second), c = seen(third);
                const float u = wp::diff_product(c.x, b.y, c.y, b.x), v = wp::diff_product(a.x, c.y, a.y, c.x);
                const float w = wp::diff_product(b.x, a.y, b.y, a.x), whole = u + v + w;
                if ((lesser(u, lesser(v, w)) >= 0.0f || larger(u, larger(v, w)) <= 0.0f) && whole != 0.0f) {
                    const float scale = 1.0f / whole, t = (u * a.z + v * b.z + w * c.z) * inverse_along * scale;
                    if (t >= 0.0f && t < best_t) {
                        FOUND
                    }
                }
            } while (!last);
            current = stack[--size];
        }
    }
""".replace("STACK", str(STACK))
_FIRST = (
    _WALK.replace("FOUND", "best_t = t; best_u = u * scale; best_v = v * scale; best = (first.w >> 1) + 1u;")
    + "return wp::vec4(best_t, best_u, best_v, real(best));"
)
_ANY = _WALK.replace("FOUND", "return true;") + "return false;"


def _on_cuda(walk: str, elsewhere: str) -> str:
    return f"#if defined(__CUDA_ARCH__)\n{walk}\n#else\n{elsewhere}\n#endif\n"


@wp.func_native(
    _on_cuda(
        _FIRST,
        r"""
    float t = reach, u = 0.0f, v = 0.0f, sign;
    wp::vec3 normal;
    union { int word; float number; } face;
    const bool met = wp::mesh_query_ray(handle, origin, direction, reach, t, u, v, sign, normal, face.word);
    face.word = met ? face.word + 1 : 0;
    return wp::vec4(t, u, v, face.number);
""",
    )
)
def first_met(handle: wp.uint64, origin: wp.vec3, direction: wp.vec3, reach: float) -> wp.vec4:
    """(t, weights of the first and second corner, the bits of the triangle's number plus one, 0: none); `trees.Tree.id`."""


@wp.func_native(_on_cuda(_ANY, "return wp::mesh_query_ray_anyhit(handle, origin, direction, reach);"))
def any_met(handle: wp.uint64, origin: wp.vec3, direction: wp.vec3, reach: float) -> bool:
    """Whether anything is met before `reach`."""


@wp.func_native(_FIRST)
def first_walked(handle: wp.uint64, origin: wp.vec3, direction: wp.vec3, reach: float) -> wp.vec4:
    """`first_met` as CUDA answers it, on any device, of a `RayTree`'s id."""


@wp.func_native(_ANY)
def any_walked(handle: wp.uint64, origin: wp.vec3, direction: wp.vec3, reach: float) -> bool:
    """`any_met` likewise."""


@wp.func_native(_on_cuda("return 0;", "return 1;"))
def loses_rays() -> int:
    """1 where a ray may go past what it is aimed at a corner of, by rounding: one that meets nothing is worth asking again."""


@wp.func
def triangle_in(answer: wp.vec4) -> int:
    """The triangle that `first_met` names; -1: none."""
    return wp.cast(answer[3], wp.int32) - 1
