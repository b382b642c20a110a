"""The walks of `heightfield.py` for several rays at a time: the same answers, bit for bit.

Every lane of a vector walks its own ray from node to node; one that is done gives its place to the next ray of its task, so
that short ways do not wait for long ones. A walk from column to column is one over a pyramid whose finest level alone is used.
What starts within the columns and meets the first of them is left to the plain walk.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import vector
from warp_reflect.grid_rays import FAR, OK, ROOF, SKY, START, STEP_LIMIT, WALL, Entry, GridTrace, miss, to_grid
from warp_reflect.heightfield import (
    START_LEVEL,
    HeightfieldView,
    enter_field,
    entry_cell,
    is_steep,
    put_hit,
    trace_field,
)
from warp_reflect.launch import FINITE_FLAGS, launch

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FINITE_FLAGS})

RAYS = wp.constant(256)  # of a task: the last of them leave places empty, which are few among so many
TASK_SPLIT_MIN = 4  # tasks
# Instead of its coarsest level, of a ray: it is answered; it is left to the plain walk.
DONE, LEFT = wp.constant(-1), wp.constant(-2)
ROWS = 7  # of `Rays.place`


@wp.struct
class Rays:
    """Rays in the grid frame where their walks begin; a row a component."""

    place: wp.array2d(dtype=float)  # origin, unit direction, time
    column: wp.array2d(
        dtype=int
    )  # column x, y; axis of the border that it came through; coarsest level used, or `DONE`


@wp.kernel
def start_rays_kernel(
    first: int,
    field: HeightfieldView,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    hierarchy: int,
    out_rays: Rays,
    out_kind: wp.array(dtype=int),
    out_t: wp.array(dtype=float),
    out_cell: wp.array(dtype=wp.vec3i),
    out_normal: wp.array(dtype=wp.vec3),
    out_steps: wp.array(dtype=int),
    out_status: wp.array(dtype=wp.uint8),
):
    """One thread per ray: where its walk begins, or that it has none."""
    i = first + wp.tid()
    ray = to_grid(field.place, origins[i], directions[i])
    status = ray.status
    entry = Entry()
    if status == OK:
        entry = enter_field(field, ray)
        if entry.inside == 0:
            status = SKY
    if status != OK:
        put_hit(i, miss(status, 0), out_kind, out_t, out_cell, out_normal, out_steps, out_status)
        out_rays.column[3, i] = DONE
        return
    for k in range(3):
        out_rays.place[k, i] = ray.origin[k]
        out_rays.place[3 + k, i] = ray.direction[k]
    out_rays.place[6, i] = entry.t
    out_rays.column[0, i] = entry_cell(0, field.nx, entry.t, ray)
    out_rays.column[1, i] = entry_cell(1, field.ny, entry.t, ray)
    out_rays.column[2, i] = entry.axis
    out_rays.column[3, i] = wp.where(hierarchy != 0 and not is_steep(field, ray), field.level_count - 1, 0)


@wp.func_native(
    vector.snippet(
        r"""
    const int end = begin + ray_count < count ? begin + ray_count : count;
    const int nx = field.nx, ny = field.ny;
    const float* heights = field.heights.data;
    const float cell = field.place.cell;
    const bool up_y = field.place.up == 1;
    const int stride = rays.place.shape[1], column_stride = rays.column.shape[1];
    const float* place = rays.place.data;
    int* column = rays.column.data;
    int level_first[32];
    for (int k = 0; k < field.level_count; ++k) level_first[k] = field.level_first.data[k];
    float of_ray[7][LANES];
    int number[LANES], xs[LANES], ys[LANES], axes[LANES], levels[LANES], mosts[LANES], walked[LANES];
    for (int l = 0; l < LANES; ++l) {
        number[l] = xs[l] = ys[l] = axes[l] = levels[l] = mosts[l] = walked[l] = 0;
        for (int k = 0; k < 7; ++k) of_ray[k][l] = 0.0f;
    }
    F ox, oy, oz, dx, dy, dz, inverse_x, inverse_y, never_x, never_y, t_in, z_in;
    I step_x, step_y, ahead_x, ahead_y, x, y, axis, level, most, steps, active = I(0);
    int next = begin;
    auto put = [&](int i, int kind, float t, int cx, int cy, int normal_axis, float normal, int status, int taken) {
        int* cells = (int*)out_cell.data + 3 * i;
        float* normals = (float*)out_normal.data + 3 * i;
        out_kind.data[i] = kind;
        out_t.data[i] = t * cell;
        cells[0] = cx; cells[1] = cy; cells[2] = kind == 0 ? -1 : 0;
        normals[0] = normals[1] = normals[2] = 0.0f;
        // The grid's third axis is up.
        const int turned = up_y && normal_axis > 0 ? 3 - normal_axis : normal_axis;
        if (kind != 0) normals[turned] = normal;
        out_steps.data[i] = taken;
        out_status.data[i] = status;
    };
    while (true) {
        // Places of rays that are done are filled a few at a time: every time costs as much as a step.
        unsigned walking = bits(active);
        const int idle = LANES - __builtin_popcount(walking);
        if (idle >= (next < end ? LANES / 4 : LANES)) {
            if (walking) {
                store(of_ray[6], t_in);
                istore(xs, x); istore(ys, y); istore(axes, axis); istore(levels, level); istore(walked, steps);
            }
            int live[LANES];
            for (int l = 0; l < LANES; ++l) {
                live[l] = walking >> l & 1 ? -1 : 0;
                if (live[l]) continue;
                while (next < end && column[3 * column_stride + next] < 0) ++next;
                if (next == end) continue;
                for (int k = 0; k < 7; ++k) of_ray[k][l] = place[k * stride + next];
                xs[l] = column[next];
                ys[l] = column[column_stride + next];
                axes[l] = column[2 * column_stride + next];
                mosts[l] = column[3 * column_stride + next];
                levels[l] = mosts[l] < start_level ? mosts[l] : start_level;
                walked[l] = 0;
                number[l] = next++;
                live[l] = -1;
            }
            active = iload(live);
            if (!bits(active)) break;
            ox = load(of_ray[0]); oy = load(of_ray[1]); oz = load(of_ray[2]);
            dx = load(of_ray[3]); dy = load(of_ray[4]); dz = load(of_ray[5]);
            t_in = load(of_ray[6]);
            x = iload(xs); y = iload(ys); axis = iload(axes); level = iload(levels); most = iload(mosts);
            steps = iload(walked);
            const I still_x = dx == 0.0f, still_y = dy == 0.0f;
            inverse_x = pick(still_x, F(0.0f), 1.0f / dx);
            inverse_y = pick(still_y, F(0.0f), 1.0f / dy);
            never_x = pick(still_x, F(far), F(0.0f));
            never_y = pick(still_y, F(far), F(0.0f));
            step_x = ipick(still_x, I(0), ipick(dx > 0.0f, I(1), I(-1)));
            step_y = ipick(still_y, I(0), ipick(dy > 0.0f, I(1), I(-1)));
            ahead_x = ipick(dx < 0.0f, I(0), I(1));
            ahead_y = ipick(dy < 0.0f, I(0), I(1));
            z_in = oz + t_in * dz;
        }
        const I out_of_steps = active & (steps >= step_limit);
        if (bits(out_of_steps)) {
            for (unsigned rest = bits(out_of_steps); rest != 0; rest &= rest - 1) {
                const int l = __builtin_ctz(rest);
                put(number[l], 0, 0.0f, -1, -1, 0, 0.0f, limit_status, steps[l]);
            }
            active &= ~out_of_steps;
            continue;
        }
        steps += 1;
        const I node_x = x >> level, node_y = y >> level;
        const I border_x = (node_x + ahead_x) << level, border_y = (node_y + ahead_y) << level;
        const F t_x = (__builtin_convertvector(border_x, F) - ox) * inverse_x + never_x;
        const F t_y = (__builtin_convertvector(border_y, F) - oy) * inverse_y + never_y;
        const F t_out = fmin(t_x, t_y);
        const F z_out = oz + t_out * dz;
        const I width = ((nx - 1) >> level) + 1;
        const I at = igather(level_first, level) + node_y * width + node_x;
        const F height = gather(heights, at);
        const I reached = active & (fmin(z_in, z_out) <= height);
        const I above_columns = level > 0;
        const I down = reached & above_columns, met = reached & ~above_columns;
        I on = active & ~reached;
        if (bits(met)) {
            for (unsigned rest = bits(met); rest != 0; rest &= rest - 1) {
                const int l = __builtin_ctz(rest);
                const int a = axis[l];
                const float h = height[l], z = z_in[l], t = t_in[l];
                if (a == start_axis) {
                    column[3 * column_stride + number[l]] = left;
                } else if (z > h || a == 2) {
                    // heightfield.meet_column
                    const float slope = dz[l];
                    float roof = (h - oz[l]) * (slope == 0.0f ? 0.0f : 1.0f / slope);
                    const float leave = t_out[l];
                    roof = roof < t ? t : roof;
                    roof = roof > leave ? leave : roof;
                    put(number[l], roof_kind, roof, x[l], y[l], 2, 1.0f, ok, steps[l]);
                } else {
                    const float along = a == 0 ? dx[l] : dy[l];
                    put(number[l], wall_kind, t, x[l], y[l], a, along > 0.0f ? -1.0f : 1.0f, ok, steps[l]);
                }
            }
            active &= ~met;
        }
        // Over the node: into the column beyond its border.
        const I first_x = t_x <= t_y;
        I to_x = x + ipick(first_x, step_x, I(0)), to_y = y + ipick(first_x, I(0), step_y);
        const I over = on & above_columns;
        if (bits(over)) {
            // grid_rays.cell_at, along the other axis, where the ray stays within the node
            const I along_x = ~first_x;
            const F o = pick(along_x, ox, oy), d = pick(along_x, dx, dy), inverse = pick(along_x, inverse_x, inverse_y);
            const I step = ipick(along_x, step_x, step_y), ahead = ipick(along_x, ahead_x, ahead_y);
            const I moves = over & (step != 0);
            const I low = ipick(along_x, node_x, node_y) << level;
            const I high = low + (I(1) << level) - 1;
            const F near = __builtin_convertvector(low, F), away = __builtin_convertvector(high, F);
            const F here = fmin(fmax(o + t_out * d, near), away);
            I c = __builtin_convertvector(__builtin_elementwise_floor(pick(moves, here, near)), I);
            c = ipick(c < low, low, ipick(c > high, high, c));
            const I last = ipick(step > 0, high, low), earliest = ipick(step > 0, low, high);
            while (true) {
                const F t_next = (__builtin_convertvector(c + ahead, F) - o) * inverse;
                const I behind = moves & (c != last) & ((t_next < t_out) | (along_x & (t_next == t_out)));
                if (!bits(behind)) break;
                c += ipick(behind, step, I(0));
            }
            while (true) {
                const F t_last = (__builtin_convertvector(c + ahead - step, F) - o) * inverse;
                const I before = moves & (c != earliest) & ((t_last > t_out) | (~along_x & (t_last == t_out)));
                if (!bits(before)) break;
                c -= ipick(before, step, I(0));
            }
            const I other = ipick(step == 0, ipick(along_x, x, y), c);
            to_x = ipick(over, ipick(along_x, other, border_x - 1 + ahead_x), to_x);
            to_y = ipick(over, ipick(along_x, border_y - 1 + ahead_y, other), to_y);
        }
        const I gone = on & ((t_out >= far) | (to_x < 0) | (to_y < 0) | (to_x >= nx) | (to_y >= ny)
            | ((dz >= 0.0f) & (z_out > field.top)));
        if (bits(gone)) {
            for (unsigned rest = bits(gone); rest != 0; rest &= rest - 1) {
                const int l = __builtin_ctz(rest);
                put(number[l], 0, 0.0f, -1, -1, 0, 0.0f, sky, steps[l]);
            }
            active &= ~gone;
            on &= ~gone;
        }
        const I above = level + 1;
        const I rises = on & (above <= most) & (((to_x >> above) != (node_x >> 1)) | ((to_y >> above) != (node_y >> 1)));
        level = ipick(down, level - 1, ipick(rises, above, level));
        axis = ipick(on, ipick(first_x, I(0), I(1)), axis);
        x = ipick(on, to_x, x);
        y = ipick(on, to_y, y);
        t_in = pick(on, t_out, t_in);
        z_in = pick(on, z_out, z_in);
    }
""",
        exact=True,
    )
)
def walk_rays(
    begin: int,
    ray_count: int,
    count: int,
    field: HeightfieldView,
    rays: Rays,
    step_limit: int,
    start_level: int,
    far: float,
    start_axis: int,
    wall_kind: int,
    roof_kind: int,
    ok: int,
    sky: int,
    limit_status: int,
    left: int,
    out_kind: wp.array(dtype=int),
    out_t: wp.array(dtype=float),
    out_cell: wp.array(dtype=wp.vec3i),
    out_normal: wp.array(dtype=wp.vec3),
    out_steps: wp.array(dtype=int),
    out_status: wp.array(dtype=wp.uint8),
): ...


@wp.kernel
def walk_rays_kernel(
    first: int,
    field: HeightfieldView,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    hierarchy: int,
    step_limit: int,
    rays: Rays,
    out_kind: wp.array(dtype=int),
    out_t: wp.array(dtype=float),
    out_cell: wp.array(dtype=wp.vec3i),
    out_normal: wp.array(dtype=wp.vec3),
    out_steps: wp.array(dtype=int),
    out_status: wp.array(dtype=wp.uint8),
):
    """One thread per task."""
    i = (first + wp.tid()) * RAYS
    count = origins.shape[0]
    walk_rays(
        i,
        RAYS,
        count,
        field,
        rays,
        step_limit,
        START_LEVEL,
        FAR,
        START,
        WALL,
        ROOF,
        OK,
        SKY,
        STEP_LIMIT,
        LEFT,
        out_kind,
        out_t,
        out_cell,
        out_normal,
        out_steps,
        out_status,
    )
    end = wp.min(i + RAYS, count)
    while i < end:
        if rays.column[3, i] == LEFT:
            hit = trace_field(field, origins[i], directions[i], hierarchy, step_limit)
            put_hit(i, hit, out_kind, out_t, out_cell, out_normal, out_steps, out_status)
        i += 1


def trace(
    view: HeightfieldView, rays: list[wp.array], hierarchy: int, step_limit: int, found: GridTrace, device, threads: int
) -> None:
    """What `heightfield.trace_heightfield_kernel` does."""
    count = len(rays[0])
    starts = Rays()
    starts.place = wp.empty((ROWS, count), dtype=float, device=device)
    starts.column = wp.empty((4, count), dtype=int, device=device)
    launch(start_rays_kernel, count, [view, *rays, hierarchy, starts, *found.arrays], device, threads)
    inputs = [view, *rays, hierarchy, step_limit, starts, *found.arrays]
    launch(walk_rays_kernel, -(-count // int(RAYS)), inputs, device, threads, split_min=TASK_SPLIT_MIN)
