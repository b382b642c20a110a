"""Text for the vector kernels that ask what a triangle is at a point: the formulas of `surface.py`, in the same order."""

from __future__ import annotations

# After `vector.snippet`'s head, in functions that have `scene` and `camera`.
HITS = r"""
    // Columns and rows of pixels, which mostly lie in one row.
    auto place = [&](I number, int width, F& column, F& line) {
        const int first = number[0] / width * width;
        const I row = !bits((number < first) | (number >= first + width)) ? I(first / width) : number / width;
        column = __builtin_convertvector(number - row * width, F);
        line = __builtin_convertvector(row, F);
    };
    // The rays of an eye through pixel coordinates: where a parallel eye's start, and directions of any length.
    struct Sight { V plane, ray; };
    const bool parallel = camera.orthographic != 0;
    auto sight = [&](F x, F y) -> Sight {
        const V plane = add(add(spread(camera.ray_corner), times(x, spread(camera.ray_dx))), times(y, spread(camera.ray_dy)));
        return Sight{plane, parallel ? spread(camera.forward) : plane};
    };
    // shapes.intersect_triangle, whose determinant is returned, and shapes.clamp_weights; 0 where there is no area.
    auto eye_weights = [&](const Sight& of, V p0, V p1, V p2, F& u, F& v) -> F {
        const V eye = spread(camera.eye);
        V a = sub(p0, eye), b = sub(p1, eye), c = sub(p2, eye);
        if (parallel) { a = sub(a, of.plane); b = sub(b, of.plane); c = sub(c, of.plane); }
        const F eu = dot(cross(sub(c, a), add(c, a)), of.ray);
        const F ev = dot(cross(sub(a, b), add(a, b)), of.ray);
        const F ew = dot(cross(sub(b, c), add(b, c)), of.ray);
        const F det = eu + ev + ew;
        const F inv = 1.0f / det;
        const F cu = pick(det != 0.0f, fmax(eu * inv, F(0.0f)), F(0.0f));
        const F cv = pick(det != 0.0f, fmax(ev * inv, F(0.0f)), F(0.0f));
        const F total = cu + cv;
        u = cu;
        v = cv;
        if (bits(total > 1.0f)) {
            u = pick(total > 1.0f, cu / total, cu);
            v = pick(total > 1.0f, cv / total, cv);
        }
        return det;
    };
    const auto* patches = scene.patches.data;
    constexpr int patch_words = sizeof(*patches) / 4;
    // Quadrics of patches: rows and shifts of `unit_from_scene`, and a, b, c.
    struct Quadric { V row[3]; F shift[3], a, b, c; };
    auto quadric_of = [&](I patch) -> Quadric {
        const float* matrix = &patches->unit_from_scene.data[0][0];
        const float* numbers = (const float*)&patches->quadric;
        F field[12];
        const I at = patch_words * patch;
        const bool alone = !bits(patch != patch[0]);
        if (alone) {
            _Pragma("clang loop unroll(full)") for (int k = 0; k < 12; ++k) field[k] = F(matrix[at[0] + k]);
        } else {
            F last[8];
            gather8(matrix, at, field);
            gather8(matrix, at + 4, last);
            _Pragma("clang loop unroll(full)") for (int k = 8; k < 12; ++k) field[k] = last[k - 4];
        }
        auto number = [&](int k) -> F { return alone ? F(numbers[at[0] + k]) : gather(numbers + k, at); };
        Quadric of;
        _Pragma("clang loop unroll(full)") for (int k = 0; k < 3; ++k) {
            of.row[k] = V{field[4 * k], field[4 * k + 1], field[4 * k + 2]};
            of.shift[k] = field[4 * k + 3];
        }
        of.a = number(0); of.b = number(1); of.c = number(2);
        return of;
    };
    // Point p in the frame of its quadric, and a vector of that frame as one of the scene.
    auto in_quadric = [&](const Quadric& of, V p) -> V {
        return V{dot(of.row[0], p) + of.shift[0], dot(of.row[1], p) + of.shift[1], dot(of.row[2], p) + of.shift[2]};
    };
    auto from_quadric = [&](const Quadric& of, V g) -> V {
        return add(add(times(g.x, of.row[0]), times(g.y, of.row[1])), times(g.z, of.row[2]));
    };
    // Triangles of lanes. In memory: addresses are made of their numbers one by one, which takes them out of a vector anew
    // for every array that is read.
    struct Triangles { int of[LANES]; Runs runs; bool one_patch; };
    auto triangles_of = [&](I tri) -> Triangles {
        Triangles t;
        istore(t.of, tri);
        asm("" : "+m"(t.of));
        t.runs = runs_of(tri);
        return t;
    };
    auto patch_of = [&](Triangles& t) -> I {
        const int* all = scene.triangle_patch.data;
        I patch = I(all[t.runs.of[0]]);
        t.one_patch = true;
        if (t.runs.alone) return patch;
        if (t.runs.few) {
            int own[4];
            for (int k = 0; k < 4; ++k) own[k] = all[t.runs.of[k]];
            t.one_patch = ((own[0] ^ own[1]) | (own[0] ^ own[2]) | (own[0] ^ own[3])) == 0;
            patch = few_words(own, t.runs.which);
        } else {
            EACH_LANE patch[l] = all[t.of[l]];
            t.one_patch = !bits(patch != patch[0]);
        }
        return patch;
    };
    // Integer fields of their patches; neighbouring points mostly share one, which is then read once.
    auto of_patch = [&](const int* field, const Triangles& t, I patch) -> I {
        return t.one_patch ? I(field[patch_words * patch[0]]) : igather(field, patch_words * patch);
    };
    // Values at their corners, by index, where they have any.
    struct Corners { V a, b, c; I has; };
    auto at_corners = [&](const Triangles& t, const auto& indices, const auto& values) -> Corners {
        Corners at = {};
        const int* index = (const int*)indices.data;
        const float* value = (const float*)values.data;
        if (t.runs.alone) {
            const int* own = index + 3 * t.runs.of[0];
            if (own[0] < 0) return at;
            return Corners{spread(value + 3 * own[0]), spread(value + 3 * own[1]), spread(value + 3 * own[2]), I(-1)};
        }
        if (t.runs.few) {
            const int last = values.shape[0] - 1;
            int named[4], start[3][4];
            bool at_end = false;
            _Pragma("clang loop unroll(full)") for (int k = 0; k < 4; ++k) {
                named[k] = index[3 * t.runs.of[k]];
                _Pragma("clang loop unroll(full)") for (int c = 0; c < 3; ++c) {
                    const int i = index[3 * t.runs.of[k] + c];
                    at_end |= i >= last;
                    start[c][k] = 3 * (i < 0 ? 0 : i);
                }
            }
            if ((named[0] & named[1] & named[2] & named[3]) < 0) return at;
            // Of the last value there are but three floats to read.
            if (!at_end) {
                F of[4];
                at.has = few_words(named, t.runs.which) >= 0;
                few_fours(value, start[0], t.runs.which, of);
                at.a = V{of[0], of[1], of[2]};
                few_fours(value, start[1], t.runs.which, of);
                at.b = V{of[0], of[1], of[2]};
                few_fours(value, start[2], t.runs.which, of);
                at.c = V{of[0], of[1], of[2]};
                return at;
            }
        }
        // Of the last triangle and the last value there are but three numbers to read.
        const I own = iload(t.of);
        I named[3];
        if (!bits(own >= indices.shape[0] - 1)) {
            int first[LANES];
            F numbers[4];
            istore(first, 3 * own);
            fours((const float*)index, first, numbers);
            for (int k = 0; k < 3; ++k) named[k] = __builtin_bit_cast(I, numbers[k]);
        } else {
            for (int k = 0; k < 3; ++k) EACH_LANE named[k][l] = index[3 * t.of[l] + k];
        }
        at.has = named[0] >= 0;
        if (!bits(at.has)) return at;
        const int last = values.shape[0] - 1;
        const bool at_end = bits((named[0] >= last) | (named[1] >= last) | (named[2] >= last)) != 0;
        auto corner = [&](int k) -> V {
            int start[LANES];
            istore(start, 3 * ipick(named[k] < 0, I(0), named[k]));
            if (!at_end) {
                F of[4];
                fours(value, start, of);
                return V{of[0], of[1], of[2]};
            }
            V v;
            EACH_LANE {
                const float* q = value + start[l];
                v.x[l] = q[0]; v.y[l] = q[1]; v.z[l] = q[2];
            }
            return v;
        };
        at.a = corner(0); at.b = corner(1); at.c = corner(2);
        return at;
    };
    auto normals_of = [&](const Triangles& t) -> Corners { return at_corners(t, scene.normal_index, scene.normals); };
    // What lies in between: normals of any length.
    auto between = [&](const Corners& of, F u, F v) -> V {
        return add(add(times(1.0f - u - v, of.a), times(u, of.b)), times(v, of.c));
    };
    // surface.hit_normal at points p of lanes `seen`; what its parts were is left in `of` and, in the quadric's frame, `q`.
    // `facet` gives the triangles' own, and is asked only where they matter.
    auto hit_normal = [&](I seen, I patch, I quadric, const auto& facet, V p, F u, F v, const Corners& smooth, Quadric& of,
                          V& q) -> V {
        V n = same(0.0f);
        if (bits(seen & ~smooth.has & ~quadric)) n = facet();
        if (bits(seen & smooth.has)) {
            const V mixed = between(smooth, u, v);
            const V kept = vpick(dot(mixed, mixed) < 0.01f, V{F(0.0f), F(0.0f), F(1.0f)}, unit(mixed));
            n = vpick(smooth.has, kept, n);
        }
        if (bits(seen & quadric)) {
            of = quadric_of(patch);
            q = in_quadric(of, p);
            n = vpick(quadric, unit(from_quadric(of, V{q.x, q.y, of.a * q.z + 0.5f * of.b})), n);
        }
        return n;
    };
    (void)place; (void)sight; (void)eye_weights; (void)of_patch; (void)patch_of; (void)normals_of; (void)hit_normal;
"""
