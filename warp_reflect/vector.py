"""Vector kernels: native snippets in which one task works on a block of elements, and whether this platform has them.

Warp's CPU code is scalar and waits for itself: every task is one chain of dependent operations. A snippet that carries 8 or
16 elements through the same branch-free operations in Clang's vector types keeps the processor busy; the type lowers to
whatever the processor has (SSE2 to AVX-512, NEON). Each lies beside its plain kernel and behind the same wrapper. The plain
kernel is the reference, runs on CUDA, and answers what a snippet leaves.

A kernel with such a snippet takes `first` and counts *blocks* of `BLOCK` elements: launch it with `block_count(n)` tasks.
"""

from __future__ import annotations

from functools import cache

import warp as wp

from warp_reflect.launch import launch, reads

wp.set_module_options({"enable_backward": False})

BLOCK = 64  # elements per task: what one of them leaves over fills the vectors of a second pass
BLOCK_SPLIT_MIN = 64  # blocks: what `launch.SPLIT_MIN` elements are

# Shared head of every snippet: types, and the few operations that vector extensions have no operator for.
_HEAD = r"""
// Unrolled: a lane that is named by a variable would be kept in memory.
#define EACH_LANE _Pragma("clang loop unroll(full)") for (int l = 0; l < LANES; ++l)
#if defined(__AVX512F__)
    constexpr int LANES = 16;
    typedef unsigned short LaneBits;
#else
    constexpr int LANES = 8;
    typedef unsigned char LaneBits;
#endif
    constexpr int BLOCK = 64;
    typedef float F __attribute__((ext_vector_type(LANES)));
    typedef int I __attribute__((ext_vector_type(LANES)));
    typedef unsigned U __attribute__((ext_vector_type(LANES)));
    typedef unsigned long long L __attribute__((ext_vector_type(LANES)));
    typedef bool B __attribute__((ext_vector_type(LANES)));
    struct V { F x, y, z; };
    // One bit per lane of a mask.
    auto bits = [](I mask) -> unsigned {
        return __builtin_bit_cast(LaneBits, __builtin_convertvector(mask < 0, B));
    };
    auto lanes = []() -> I { I v; EACH_LANE v[l] = l; return v; };
    auto pick = [](I mask, F a, F b) -> F { return mask ? a : b; };
    auto ipick = [](I mask, I a, I b) -> I { return mask ? a : b; };
    auto fmin = [](F a, F b) -> F { return a < b ? a : b; };
    auto fmax = [](F a, F b) -> F { return a > b ? a : b; };
    auto sub = [](V a, V b) -> V { return V{a.x - b.x, a.y - b.y, a.z - b.z}; };
    auto add = [](V a, V b) -> V { return V{a.x + b.x, a.y + b.y, a.z + b.z}; };
    auto dot = [](V a, V b) -> F { return a.x * b.x + a.y * b.y + a.z * b.z; };
    auto cross = [](V a, V b) -> V {
        return V{a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
    };
    auto times = [](F s, V a) -> V { return V{s * a.x, s * a.y, s * a.z}; };
    auto product = [](V a, V b) -> V { return V{a.x * b.x, a.y * b.y, a.z * b.z}; };
    auto vpick = [](I mask, V a, V b) -> V { return V{mask ? a.x : b.x, mask ? a.y : b.y, mask ? a.z : b.z}; };
    auto same = [](float s) -> V { return V{F(s), F(s), F(s)}; };
    auto grey = [](F s) -> V { return V{s, s, s}; };
    auto spread = [](const auto& a) -> V { return V{F(a[0]), F(a[1]), F(a[2])}; };
    auto size = [fmax](V a) -> F {
        return fmax(fmax(__builtin_elementwise_abs(a.x), __builtin_elementwise_abs(a.y)), __builtin_elementwise_abs(a.z));
    };
    auto clip = [fmin, fmax](F a, float low, float high) -> F { return fmin(fmax(a, F(low)), F(high)); };
    // shapes.unit
    auto unit = [&](V a) -> V {
        const F square = dot(a, a);
        const I safe = (square > 1.0e-24f) & (square < 1.0e24f);
        V result = times(1.0f / __builtin_elementwise_sqrt(square), a);
        if (bits(~safe)) {
            const F m = size(a);
            const F inverse = 1.0f / m;
            const V s = times(inverse, a);
            const V scaled = times(1.0f / __builtin_elementwise_sqrt(dot(s, s)), s);
            result = vpick(safe, result, vpick(m == 0.0f, same(0.0f), scaled));
        }
        return result;
    };
    // shapes.facet_normal
    auto facet_normal = [&](V p0, V p1, V p2) -> V {
        const V e1 = sub(p1, p0), e2 = sub(p2, p0);
        const V n = cross(e1, e2);
        const F square = dot(n, n);
        const I safe = (square > 1.0e-24f) & (square < 1.0e24f);
        V result = times(1.0f / __builtin_elementwise_sqrt(square), n);
        if (bits(~safe)) {
            const F m = fmax(size(e1), size(e2));
            const F inverse = 1.0f / m;
            const V scaled = unit(cross(times(inverse, e1), times(inverse, e2)));
            result = vpick(safe, result, vpick(m == 0.0f, same(0.0f), scaled));
        }
        return result;
    };
    auto load = [](const float* p) -> F { F v; __builtin_memcpy(&v, p, sizeof(v)); return v; };
    auto iload = [](const int* p) -> I { I v; __builtin_memcpy(&v, p, sizeof(v)); return v; };
    auto store = [](float* p, F v) { __builtin_memcpy(p, &v, sizeof(v)); };
    auto istore = [](int* p, I v) { __builtin_memcpy(p, &v, sizeof(v)); };
    // Elements index[l] of an array.
    auto gather = [](const float* p, I index) -> F { F v; EACH_LANE v[l] = p[index[l]]; return v; };
    auto igather = [](const int* p, I index) -> I { I v; EACH_LANE v[l] = p[index[l]]; return v; };
    // Low and high halves of LANES 64-bit words.
    auto halves = [](const unsigned long long* p, I& low, I& high) {
        I a, b;
        __builtin_memcpy(&a, p, sizeof(a));
        __builtin_memcpy(&b, p + LANES / 2, sizeof(b));
#if defined(__AVX512F__)
        low = __builtin_shufflevector(a, b, 0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
        high = __builtin_shufflevector(a, b, 1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31);
#else
        low = __builtin_shufflevector(a, b, 0, 2, 4, 6, 8, 10, 12, 14);
        high = __builtin_shufflevector(a, b, 1, 3, 5, 7, 9, 11, 13, 15);
#endif
    };
    // Words of two vectors in turn, within blocks of 128 bits, which no shuffle here crosses where it need not: the first or
    // last two words of each block, or its first or last pair.
    typedef float Four __attribute__((ext_vector_type(4)));
    typedef float Row __attribute__((ext_vector_type(8)));
#if defined(__AVX512F__)
    auto first_words = [](auto a, auto b) -> decltype(a) {
        return __builtin_shufflevector(a, b, 0, 16, 1, 17, 4, 20, 5, 21, 8, 24, 9, 25, 12, 28, 13, 29);
    };
    auto last_words = [](auto a, auto b) -> decltype(a) {
        return __builtin_shufflevector(a, b, 2, 18, 3, 19, 6, 22, 7, 23, 10, 26, 11, 27, 14, 30, 15, 31);
    };
    auto first_pairs = [](F a, F b) -> F {
        return __builtin_shufflevector(a, b, 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29);
    };
    auto last_pairs = [](F a, F b) -> F {
        return __builtin_shufflevector(a, b, 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31);
    };
    auto joined = [](const Four* r) -> F {
        const Row low = __builtin_shufflevector(r[0], r[1], 0, 1, 2, 3, 4, 5, 6, 7);
        const Row high = __builtin_shufflevector(r[2], r[3], 0, 1, 2, 3, 4, 5, 6, 7);
        return __builtin_shufflevector(low, high, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    };
#else
    auto first_words = [](auto a, auto b) -> decltype(a) { return __builtin_shufflevector(a, b, 0, 8, 1, 9, 4, 12, 5, 13); };
    auto last_words = [](auto a, auto b) -> decltype(a) { return __builtin_shufflevector(a, b, 2, 10, 3, 11, 6, 14, 7, 15); };
    auto first_pairs = [](F a, F b) -> F { return __builtin_shufflevector(a, b, 0, 1, 8, 9, 4, 5, 12, 13); };
    auto last_pairs = [](F a, F b) -> F { return __builtin_shufflevector(a, b, 2, 3, 10, 11, 6, 7, 14, 15); };
    auto joined = [](const Four* r) -> F { return __builtin_shufflevector(r[0], r[1], 0, 1, 2, 3, 4, 5, 6, 7); };
#endif
    // Four rows of four floats in each block of 128 bits, as columns.
    auto four_columns = [first_words, last_words, first_pairs, last_pairs](const F* r, F* out) {
        const F s = first_words(r[0], r[1]), t = first_words(r[2], r[3]);
        const F u = last_words(r[0], r[1]), v = last_words(r[2], r[3]);
        out[0] = first_pairs(s, t);
        out[1] = last_pairs(s, t);
        out[2] = first_pairs(u, v);
        out[3] = last_pairs(u, v);
    };
    // Four floats at p[start_of(l)] of every lane l, as four vectors. They are read into place.
    auto fours_at = [joined, four_columns](const float* p, auto start_of, F* out) {
        F r[4];
        _Pragma("clang loop unroll(full)") for (int k = 0; k < 4; ++k) {
            Four part[LANES / 4];
            _Pragma("clang loop unroll(full)") for (int l = 0; l < LANES / 4; ++l)
                __builtin_memcpy(&part[l], p + start_of(4 * l + k), sizeof(Four));
            r[k] = joined(part);
        }
        four_columns(r, out);
    };
    auto fours = [fours_at](const float* p, const int* start, F* out) {
        fours_at(p, [start](int lane) { return start[lane]; }, out);
    };
    // Lanes that lie side by side often ask for the same: alone, or in at most four runs, each of which asks once;
    // `spread_out` gives every lane its own.
    struct Runs { bool alone, few; int of[4]; I which; };
    auto runs_of = [bits, lanes](I words) -> Runs {
        Runs runs;
        int all[LANES];
        __builtin_memcpy(all, &words, sizeof(all));
#if defined(__AVX512F__)
        const I before = __builtin_shufflevector(words, words, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14);
#else
        const I before = __builtin_shufflevector(words, words, 0, 0, 1, 2, 3, 4, 5, 6);
#endif
        unsigned starts = bits(words != before);
        runs.alone = starts == 0;
        runs.of[0] = all[0];
        runs.which = I(0);
        _Pragma("clang loop unroll(full)") for (int k = 1; k < 4; ++k) {
            const int start = __builtin_ctz(starts | 1u << LANES);
            starts &= starts - 1;
            runs.of[k] = all[start & (LANES - 1)];
            runs.which -= lanes() >= start;
        }
        runs.few = starts == 0;
        return runs;
    };
    // Of vectors whose blocks of 128 bits are all the same.
    auto spread_out = [](F blocks, I which) -> F {
#ifdef __AVX512F__
        return __builtin_ia32_vpermilvarps512(blocks, which);
#elif defined(__AVX__)
        typedef int Words __attribute__((ext_vector_type(8)));
        _Pragma("clang loop unroll(full)") for (int part = 0; part < LANES; part += 8) {
            Row row;
            Words own;
            __builtin_memcpy(&row, (const float*)&blocks + part, sizeof(row));
            __builtin_memcpy(&own, (const int*)&which + part, sizeof(own));
            row = __builtin_ia32_vpermilvarps256(row, own);
            __builtin_memcpy((float*)&blocks + part, &row, sizeof(row));
        }
        return blocks;
#else
        F v;
        EACH_LANE v[l] = blocks[which[l] & 3];
        return v;
#endif
    };
    auto few_fours = [fours_at, spread_out](const float* p, const int* start, I which, F* out) {
        fours_at(p, [start](int lane) { return start[lane % 4]; }, out);
        _Pragma("clang loop unroll(full)") for (int k = 0; k < 4; ++k) out[k] = spread_out(out[k], which);
    };
    auto few_words = [joined, spread_out](const int* words, I which) -> I {
        Four one, part[LANES / 4];
        __builtin_memcpy(&one, words, sizeof(one));
        _Pragma("clang loop unroll(full)") for (int l = 0; l < LANES / 4; ++l) part[l] = one;
        return __builtin_bit_cast(I, spread_out(joined(part), which));
    };
    // Eight floats.
#if defined(__AVX512F__)
    auto gather8 = [four_columns](const float* p, I start, F* out) {
        // Half a vector an element, and half of the loads that four floats at a time take: of each block of 128 bits that comes
        // out, the first and the third are of the first four floats.
        int at[LANES];
        __builtin_memcpy(at, &start, sizeof(at));
        F columns[2][4];
        _Pragma("clang loop unroll(full)") for (int half = 0; half < 2; ++half) {
            F r[4];
            _Pragma("clang loop unroll(full)") for (int k = 0; k < 4; ++k) {
                Row a, b;
                __builtin_memcpy(&a, p + at[8 * half + k], sizeof(a));
                __builtin_memcpy(&b, p + at[8 * half + 4 + k], sizeof(b));
                r[k] = __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
            }
            four_columns(r, columns[half]);
        }
        _Pragma("clang loop unroll(full)") for (int k = 0; k < 4; ++k) {
            out[k] = __builtin_shufflevector(
                columns[0][k], columns[1][k], 0, 1, 2, 3, 8, 9, 10, 11, 16, 17, 18, 19, 24, 25, 26, 27);
            out[k + 4] = __builtin_shufflevector(
                columns[0][k], columns[1][k], 4, 5, 6, 7, 12, 13, 14, 15, 20, 21, 22, 23, 28, 29, 30, 31);
        }
    };
#else
    auto gather8 = [fours](const float* p, I start, F* out) {
        int at[LANES];
        __builtin_memcpy(at, &start, sizeof(at));
        fours(p, at, out);
        fours(p + 4, at, out + 4);
    };
#endif
    // Eight rows of eight floats each, at p[start[k]], as columns.
    auto transposed = [](const float* p, const int* start, Row* out) {
        _Pragma("clang loop unroll(full)") for (int half = 0; half < 8; half += 4) {
            Row r[4];
            _Pragma("clang loop unroll(full)") for (int k = 0; k < 4; ++k) {
                Four a, b;
                __builtin_memcpy(&a, p + start[k] + half, sizeof(a));
                __builtin_memcpy(&b, p + start[k + 4] + half, sizeof(b));
                r[k] = __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7);
            }
            const Row s = __builtin_shufflevector(r[0], r[1], 0, 8, 1, 9, 4, 12, 5, 13);
            const Row t = __builtin_shufflevector(r[2], r[3], 0, 8, 1, 9, 4, 12, 5, 13);
            const Row u = __builtin_shufflevector(r[0], r[1], 2, 10, 3, 11, 6, 14, 7, 15);
            const Row v = __builtin_shufflevector(r[2], r[3], 2, 10, 3, 11, 6, 14, 7, 15);
            out[half] = __builtin_shufflevector(s, t, 0, 1, 8, 9, 4, 5, 12, 13);
            out[half + 1] = __builtin_shufflevector(s, t, 2, 3, 10, 11, 6, 7, 14, 15);
            out[half + 2] = __builtin_shufflevector(u, v, 0, 1, 8, 9, 4, 5, 12, 13);
            out[half + 3] = __builtin_shufflevector(u, v, 2, 3, 10, 11, 6, 7, 14, 15);
        }
    };
    auto vgather = [](const float* p, I index) -> V {
        V v;
        EACH_LANE {
            const float* q = p + 3 * index[l];
            v.x[l] = q[0]; v.y[l] = q[1]; v.z[l] = q[2];
        }
        return v;
    };
    // Elements start .. start + LANES - 1 of an array of three floats each: rows are read and turned; and back.
    auto vload = [](const float* p, int start) -> V {
        F a, b, c;
        __builtin_memcpy(&a, p + 3 * start, sizeof(a));
        __builtin_memcpy(&b, p + 3 * start + LANES, sizeof(b));
        __builtin_memcpy(&c, p + 3 * start + 2 * LANES, sizeof(c));
#if defined(__AVX512F__)
        const F x = __builtin_shufflevector(a, b, 0, 3, 6, 9, 12, 15, 18, 21, 24, 27, 30, -1, -1, -1, -1, -1);
        const F y = __builtin_shufflevector(a, b, 1, 4, 7, 10, 13, 16, 19, 22, 25, 28, 31, -1, -1, -1, -1, -1);
        const F z = __builtin_shufflevector(a, b, 2, 5, 8, 11, 14, 17, 20, 23, 26, 29, -1, -1, -1, -1, -1, -1);
        return V{
            __builtin_shufflevector(x, c, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 17, 20, 23, 26, 29),
            __builtin_shufflevector(y, c, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 18, 21, 24, 27, 30),
            __builtin_shufflevector(z, c, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 16, 19, 22, 25, 28, 31)};
#else
        return V{
            __builtin_shufflevector(__builtin_shufflevector(a, b, 0, 3, 6, 9, 12, 15, -1, -1), c, 0, 1, 2, 3, 4, 5, 10, 13),
            __builtin_shufflevector(__builtin_shufflevector(a, b, 1, 4, 7, 10, 13, -1, -1, -1), c, 0, 1, 2, 3, 4, 8, 11, 14),
            __builtin_shufflevector(__builtin_shufflevector(a, b, 2, 5, 8, 11, 14, -1, -1, -1), c, 0, 1, 2, 3, 4, 9, 12, 15)};
#endif
    };
    auto vstore = [](float* p, int start, V v) {
#if defined(__AVX512F__)
        const F a = __builtin_shufflevector(
            __builtin_shufflevector(v.x, v.y, 0, 16, -1, 1, 17, -1, 2, 18, -1, 3, 19, -1, 4, 20, -1, 5), v.z,
            0, 1, 16, 3, 4, 17, 6, 7, 18, 9, 10, 19, 12, 13, 20, 15);
        const F b = __builtin_shufflevector(
            __builtin_shufflevector(v.x, v.y, 21, -1, 6, 22, -1, 7, 23, -1, 8, 24, -1, 9, 25, -1, 10, 26), v.z,
            0, 21, 2, 3, 22, 5, 6, 23, 8, 9, 24, 11, 12, 25, 14, 15);
        const F c = __builtin_shufflevector(
            __builtin_shufflevector(v.x, v.y, -1, 11, 27, -1, 12, 28, -1, 13, 29, -1, 14, 30, -1, 15, 31, -1), v.z,
            26, 1, 2, 27, 4, 5, 28, 7, 8, 29, 10, 11, 30, 13, 14, 31);
#else
        const F a = __builtin_shufflevector(
            __builtin_shufflevector(v.x, v.y, 0, 8, -1, 1, 9, -1, 2, 10), v.z, 0, 1, 8, 3, 4, 9, 6, 7);
        const F b = __builtin_shufflevector(
            __builtin_shufflevector(v.x, v.y, -1, 3, 11, -1, 4, 12, -1, 5), v.z, 10, 1, 2, 11, 4, 5, 12, 7);
        const F c = __builtin_shufflevector(
            __builtin_shufflevector(v.x, v.y, 13, -1, 6, 14, -1, 7, 15, -1), v.z, 0, 13, 2, 3, 14, 5, 6, 15);
#endif
        __builtin_memcpy(p + 3 * start, &a, sizeof(a));
        __builtin_memcpy(p + 3 * start + LANES, &b, sizeof(b));
        __builtin_memcpy(p + 3 * start + 2 * LANES, &c, sizeof(c));
    };
    // Four floats an element, of which v has the first three.
    auto vstore4 = [first_words, last_words, first_pairs, last_pairs](float* p, int start, V v, F w) {
        const F xy = first_words(v.x, v.y), XY = last_words(v.x, v.y), zw = first_words(v.z, w), ZW = last_words(v.z, w);
        // Elements 0, 4, .., and 1, 5, .., and so on.
        const F a = first_pairs(xy, zw), b = last_pairs(xy, zw), c = first_pairs(XY, ZW), d = last_pairs(XY, ZW);
#if defined(__AVX512F__)
        auto first_blocks = [](F a, F b) -> F {
            return __builtin_shufflevector(a, b, 0, 1, 2, 3, 16, 17, 18, 19, 8, 9, 10, 11, 24, 25, 26, 27);
        };
        auto last_blocks = [](F a, F b) -> F {
            return __builtin_shufflevector(a, b, 4, 5, 6, 7, 20, 21, 22, 23, 12, 13, 14, 15, 28, 29, 30, 31);
        };
        auto first_half = [](F a, F b) -> F {
            return __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23);
        };
        auto last_half = [](F a, F b) -> F {
            return __builtin_shufflevector(a, b, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
        };
        const F ab = first_blocks(a, b), cd = first_blocks(c, d), AB = last_blocks(a, b), CD = last_blocks(c, d);
        const F rows[4] = {first_half(ab, cd), first_half(AB, CD), last_half(ab, cd), last_half(AB, CD)};
#else
        const F rows[4] = {
            __builtin_shufflevector(a, b, 0, 1, 2, 3, 8, 9, 10, 11), __builtin_shufflevector(c, d, 0, 1, 2, 3, 8, 9, 10, 11),
            __builtin_shufflevector(a, b, 4, 5, 6, 7, 12, 13, 14, 15), __builtin_shufflevector(c, d, 4, 5, 6, 7, 12, 13, 14, 15)};
#endif
        __builtin_memcpy(p + 4 * start, rows, sizeof(rows));
    };
    // The same of what may end before: then the lanes' own numbers count.
    auto vrows = [vload, vgather](const float* p, int start, bool full, I own) -> V {
        return full ? vload(p, start) : vgather(p, own);
    };
    auto frow = [load, gather](const float* p, int start, bool full, I own) -> F {
        return full ? load(p + start) : gather(p, own);
    };
    auto irow = [iload, igather](const int* p, int start, bool full, I own) -> I {
        return full ? iload(p + start) : igather(p, own);
    };
    // Corners of triangles, from `Scene.triangle_records`.
    auto corners_of = [fours, few_fours](const float* records, I triangle, const Runs& runs, V& p0, V& p1, V& p2) {
        if (runs.alone) {
            const float* p = records + 12 * runs.of[0];
            p0 = V{F(p[0]), F(p[1]), F(p[2])};
            p1 = V{F(p[3]), F(p[4]), F(p[5])};
            p2 = V{F(p[6]), F(p[7]), F(p[8])};
            return;
        }
        F corner[12];
        if (runs.few) {
            int at[4];
            for (int k = 0; k < 4; ++k) at[k] = 12 * runs.of[k];
            _Pragma("clang loop unroll(full)") for (int k = 0; k < 12; k += 4)
                few_fours(records + k, at, runs.which, corner + k);
        } else {
            int at[LANES];
            const I start = 12 * triangle;
            __builtin_memcpy(at, &start, sizeof(at));
            _Pragma("clang loop unroll(full)") for (int k = 0; k < 12; k += 4) fours(records + k, at, corner + k);
        }
        p0 = V{corner[0], corner[1], corner[2]};
        p1 = V{corner[3], corner[4], corner[5]};
        p2 = V{corner[6], corner[7], corner[8]};
    };
    auto corners = [corners_of, runs_of](const float* records, I triangle, V& p0, V& p1, V& p2) {
        corners_of(records, triangle, runs_of(triangle), p0, p1, p2);
    };
    (void)bits; (void)lanes; (void)pick; (void)ipick; (void)fmin; (void)fmax; (void)sub; (void)add; (void)dot; (void)cross;
    (void)load; (void)iload; (void)store; (void)istore; (void)gather; (void)igather; (void)vgather; (void)halves; (void)fours;
    (void)gather8; (void)product; (void)vpick; (void)same; (void)grey; (void)spread; (void)clip; (void)unit; (void)corners;
    (void)facet_normal; (void)vload; (void)vstore; (void)vstore4; (void)vrows; (void)frow; (void)irow; (void)transposed;
    (void)few_words; (void)corners_of;
"""

# Beside it, for what does not go on in all lanes.
PACKED = r"""
    // Puts the words of the lanes that are marked one after the other; up to LANES words at `to` are written.
    auto packed = [](int* to, I words, unsigned marked) -> int {
#if defined(__AVX512F__)
        const I together = __builtin_ia32_compresssi512_mask(words, I(0), (unsigned short)marked);
        __builtin_memcpy(to, &together, sizeof(together));
        return __builtin_popcount(marked);
#elif defined(__AVX2__)
        struct Order { unsigned long long of[256]; };
        static constexpr Order order = []() constexpr {
            Order made{};
            for (int mask = 0; mask < 256; ++mask)
                for (int l = 0, n = 0; l < 8; ++l)
                    if (mask >> l & 1) made.of[mask] |= (unsigned long long)l << 8 * n++;
            return made;
        }();
        typedef int Words __attribute__((ext_vector_type(8)));
        typedef unsigned char Bytes __attribute__((ext_vector_type(8)));
        int count = 0;
        _Pragma("clang loop unroll(full)") for (int part = 0; part < LANES; part += 8) {
            const unsigned own = marked >> part & 255;
            Words eight;
            __builtin_memcpy(&eight, (const int*)&words + part, sizeof(eight));
            eight = __builtin_ia32_permvarsi256(eight,
                __builtin_convertvector(__builtin_bit_cast(Bytes, order.of[own]), Words));
            __builtin_memcpy(to + count, &eight, sizeof(eight));
            count += __builtin_popcount(own);
        }
        return count;
#else
        int count = 0;
        EACH_LANE { to[count] = words[l]; count += marked >> l & 1; }
        return count;
#endif
    };
    (void)packed;
"""

# For the rasteriser's snippets: rows of triangles.
TRIANGLES = (
    PACKED
    + r"""
    auto marks = [bits](I mask) -> unsigned {
#if defined(__AVX__) && !defined(__AVX512F__)
        return __builtin_ia32_movmskps256(__builtin_bit_cast(F, mask));
#else
        return bits(mask);
#endif
    };
    // The mask of marks. Masks that are kept over a branch are turned into truth values of 16 bits and back; numbers are not.
    auto marked = [lanes](unsigned marks) -> I { return (I(marks) << (31 - lanes())) < 0; };
    auto least = [](I p, I q) -> I { return p < q ? p : q; };
    auto most = [](I p, I q) -> I { return p > q ? p : q; };
    auto snap = [](F x) -> I { return __builtin_convertvector(__builtin_elementwise_floor(x * 256.0f + 0.5f), I); };
    // Triangles on the screen: (x, y, key) of their corners, which of them have a picture, which of those are to be clipped, and
    // of the others snapped corners, 0 where there is none, and the box of pixel centres within a target.
    struct Corners { V v[3]; I kept, clipped, sound, x[3], y[3], left, right, top, bottom, small; };
    auto cornered = [&](const int* corners, int stride, const float* screen, float guard, int x0, int y0, int x1, int y1)
        __attribute__((always_inline)) -> Corners {
        Corners c;
        _Pragma("clang loop unroll(full)") for (int each = 0; each < 3; ++each) {
            int at[LANES];
            EACH_LANE at[l] = 4 * corners[stride * l + each];
            F of[4];
            fours(screen, at, of);
            c.v[each] = V{of[0], of[1], of[2]};
        }
        F reach = F(0.0f);
        _Pragma("clang loop unroll(full)") for (int each = 0; each < 3; ++each)
            reach = fmax(reach, fmax(__builtin_elementwise_abs(c.v[each].x), __builtin_elementwise_abs(c.v[each].y)));
        const F farthest = fmin(c.v[0].z, fmin(c.v[1].z, c.v[2].z)), sum = c.v[0].z + c.v[1].z + c.v[2].z;
        // Dropped vertices, and those that are not a number.
        c.kept = (farthest >= 0.0f) & (sum >= 0.0f);
        c.clipped = c.kept & ((farthest == 0.0f) | (reach > guard));
        // What is no finite number snaps to no pixel.
        const I finite = (c.v[0].x + c.v[1].x + c.v[2].x + c.v[0].y + c.v[1].y + c.v[2].y + sum) * 0.0f == 0.0f;
        c.sound = c.kept & finite & ~c.clipped;
        _Pragma("clang loop unroll(full)") for (int each = 0; each < 3; ++each) {
            c.x[each] = snap(pick(c.sound, c.v[each].x, F(0.0f)));
            c.y[each] = snap(pick(c.sound, c.v[each].y, F(0.0f)));
        }
        const I low_x = least(c.x[0], least(c.x[1], c.x[2])), high_x = most(c.x[0], most(c.x[1], c.x[2]));
        const I low_y = least(c.y[0], least(c.y[1], c.y[2])), high_y = most(c.y[0], most(c.y[1], c.y[2]));
        c.left = most((low_x + 127) >> 8, I(x0));
        c.right = least((high_x - 128) >> 8, I(x1 - 1));
        c.top = most((low_y + 127) >> 8, I(y0));
        c.bottom = least((high_y - 128) >> 8, I(y1 - 1));
        c.small = (high_x - low_x <= 64 * 256) & (high_y - low_y <= 64 * 256);
        return c;
    };
    // raster.beside
    auto beside = [](const int* corners, const float* screen, const auto& target) -> bool {
        int beyond = 31;
        for (int each = 0; each < 3; ++each) {
            const float* v = screen + 4 * corners[each];
            const float w = v[2] > 0.0f || target.orthographic != 0 ? 1.0f : v[3];
            beyond &= (v[0] < target.x0 * w) | (v[0] > target.x1 * w) << 1 | (v[1] < target.y0 * w) << 2
                | (v[1] > target.y1 * w) << 3 | (v[3] < target.near) << 4;
        }
        return beyond != 0;
    };
    // raster.edge_bias
    auto edge_bias = [](I dx, I dy) -> I { return ((dy < 0) | ((dy == 0) & (dx > 0))) ? I(0) : I(-1); };
    (void)marks; (void)marked; (void)cornered; (void)beside; (void)edge_bias;
"""
)

# After those: one triangle of corners a, b, c into rows of a target, as `raster.draw_triangle` sets it up.
ONE_TRIANGLE = r"""
    typedef double D __attribute__((ext_vector_type(LANES)));
    auto lesser = [](int p, int q) -> int { return p < q ? p : q; };
    auto larger = [](int p, int q) -> int { return p > q ? p : q; };
    const int xa = snap(F(a[0]))[0], ya = snap(F(a[1]))[0];
    int xb = snap(F(b[0]))[0], yb = snap(F(b[1]))[0], xc = snap(F(c[0]))[0], yc = snap(F(c[1]))[0];
    float kb = b[2], kc = c[2];
    long long area = (long long)(xb - xa) * (yc - ya) - (long long)(yb - ya) * (xc - xa);
    if (area == 0) return;
    if (area < 0) {
        area = -area;
        const int x = xb, y = yb;
        const float k = kb;
        xb = xc; yb = yc; kb = kc;
        xc = x; yc = y; kc = k;
    }
    const int low_x = lesser(xa, lesser(xb, xc)), high_x = larger(xa, larger(xb, xc));
    const int low_y = lesser(ya, lesser(yb, yc)), high_y = larger(ya, larger(yb, yc));
    const int left = larger((low_x + 127) >> 8, target.x0), right = lesser((high_x - 128) >> 8, target.x1 - 1);
    const int top = larger((low_y + 127) >> 8, larger(target.y0, row_first));
    const int bottom = lesser((high_y - 128) >> 8, lesser(target.y1, row_end) - 1);
    if (left > right || top > bottom) return;
    const int dxa = xc - xb, dya = yc - yb, dxb = xa - xc, dyb = ya - yc, dxc = xb - xa, dyc = yb - ya;
    const int px = left * 256 + 128, py = top * 256 + 128;
    const long long ea0 = (long long)dxa * (py - yb) - (long long)dya * (px - xb);
    const long long eb0 = (long long)dxb * (py - yc) - (long long)dyb * (px - xc);
    const long long ec0 = (long long)dxc * (py - ya) - (long long)dyc * (px - xa);
    const int bias_a = edge_bias(I(dxa), I(dya))[0], bias_b = edge_bias(I(dxb), I(dyb))[0];
    const int bias_c = edge_bias(I(dxc), I(dyc))[0];
    const float inv_area = 1.0f / (float)area;
    const int low = ~triangle;
"""


def snippet(body: str, elsewhere: str = "", wide: bool = False, exact: bool = False) -> str:
    """The text of a native function: `body` after the shared head on a CPU, `elsewhere` for CUDA (never launched there).

    Args:
        exact: Products and sums are rounded one by one, as those of plain kernels are: the same bits.
        wide: 16 lanes whatever the processor has: two vectors of eight go side by side where every operation waits for the
            one before it.
    """
    head = _HEAD.replace("#if defined(__AVX512F__)", "#if 1") if wide else _HEAD
    if exact:
        head = "#pragma clang fp contract(off)\n" + head
    # Warp builds every kernel twice, for arrays with and without gaps between elements; this is in both, and built once.
    once = f"auto whole_task = [&]() __attribute__((noinline)) {{\n{head}{body}\n}};\nreturn whole_task();\n"
    return f"#if !defined(__CUDACC_RTC__) && !defined(__CUDA_ARCH__)\n{once}#else\n{elsewhere}\n#endif\n"


def block_count(count: int) -> int:
    """Tasks over `count` elements."""
    return -(-count // BLOCK)


def launch_blocks(
    kernel,
    count: int,
    inputs: list,
    device,
    threads: int = 0,
    blocks: int = 1,
    split_min: int = BLOCK_SPLIT_MIN,
) -> None:
    """Run a vector kernel, whose arguments after `first` are `inputs`, over `count` elements.

    Args:
        blocks: Of each of its tasks.
        split_min: Blocks from which on it is split over threads.
    """
    launch(kernel, -(-block_count(count) // blocks), inputs, device, threads, split_min=split_min // blocks)


@wp.func_native(
    snippet(r"""
    F x = __builtin_convertvector(lanes(), F) + 1.0f;
    V v = cross(V{x, x, x}, V{x, x + 1.0f, x});
    F root = __builtin_elementwise_sqrt(fmax(dot(v, v), x));
    EACH_LANE out.data[l] = bits(root > 1.0f) != 0 ? root[l] : 0.0f;
    for (int l = LANES; l < BLOCK; ++l) out.data[l] = __builtin_sqrtf(2.0f) * (l + 1);
""")
)
def probe(out: wp.array(dtype=float)): ...


@wp.kernel
def probe_kernel(first: int, out: wp.array(dtype=float)):
    probe(out)


@cache
def missing() -> str:
    """Why vector kernels cannot run on this machine's CPU; empty where they can. Compiles a small one to find out."""
    try:
        out = wp.zeros(BLOCK, dtype=float, device="cpu")
        launch(probe_kernel, 1, [out], "cpu", 1)
        values = out.numpy()
    except Exception as error:  # whatever a foreign compiler says
        return f"the compiler refuses them: {str(error).splitlines()[0][:120] if str(error) else type(error).__name__}"
    good = all(abs(value - 2.0**0.5 * (k + 1)) < 1.0e-5 * (k + 1) for k, value in enumerate(values))
    return "" if good else "they compile but calculate wrongly"


def chosen(kernels: str, device) -> bool:
    """Whether the vector form of a kernel runs.

    Args:
        kernels: `Settings.kernels`.
        device: Warp device; CUDA has the plain kernels, and so has what goes its way (`launch.unread`).

    Raises:
        RuntimeError: `vector` was asked for and this CPU's compiler has none.
    """
    if kernels == "plain" or not reads() or wp.get_device(device).is_cuda:
        return False
    if kernels == "vector" and missing():
        raise RuntimeError(f"kernels=vector: {missing()}; use kernels=auto")
    return not missing()
