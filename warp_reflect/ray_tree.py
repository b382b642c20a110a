"""A triangle BVH of Warp with four children a node, in the layout that single rays walk on CUDA (`ray_query.py`).

A node is 64 bytes, half a line of a cache: the corner of a grid and its steps, a power of two on each axis; the children; their
boxes in steps of the grid, a byte each. A triangle is its three corners one after the other, in the order of the leaves. All of
it is laid out and fitted on the mesh's device, from the boxes of Warp's tree: the children of a node's largest branches take
its place until there are four, and branches of few triangles are leaves.

Sources: Ylitie, Karras and Laine, Efficient Incoherent Ray Traversal on GPUs Through Compressed Wide BVHs, HPG 2017; Wald,
Benthin and Boulos, Getting Rid of Packets, RT 2008. The layout of Warp's tree is that of warp/native/bvh.h.
"""

from __future__ import annotations

import warp as wp

from warp_reflect.launch import launch

wp.set_module_options({"enable_backward": False})

WIDTH = 4  # children of a node
# The grid's corner; its steps' exponents, a byte each; the children, nodes or ~ the first triangle of a leaf; bytes of the least
# x, y and z of all children; of the most x, y and z.
NODE_WORDS = 16
# Each corner's x, y, z; after the first's, twice the triangle's number, and one more if the leaf ends with it.
TRIANGLE_WORDS = 12
LEAF = 3  # triangles at most, but in leaves of Warp's own
STACK = 64  # of a walk, which leaves three children behind at each node
DEEPEST = (STACK - 1) // (WIDTH - 1)  # levels of nodes

_TREE = r"""
    const wp::Mesh& mesh = *(const wp::Mesh*)mesh_id;
    const wp::BVHPackedNodeHalf* lowers = mesh.bvh.node_lowers;
    const wp::BVHPackedNodeHalf* uppers = mesh.bvh.node_uppers;
"""


@wp.func_native("return *((const wp::Mesh*)mesh_id)->bvh.root;")
def root_of(mesh_id: wp.uint64) -> int: ...


@wp.func_native(
    _TREE
    + r"""
#if defined(__CUDA_ARCH__)
    auto taken = [&](int which, int count) -> int { return atomicAdd(out_counts.data + which, count); };
#else
    auto taken = [&](int which, int count) -> int { out_counts.data[which] += count; return out_counts.data[which] - count; };
#endif
    auto area = [&](int branch) -> float {
        const float x = uppers[branch].x - lowers[branch].x, y = uppers[branch].y - lowers[branch].y;
        const float z = uppers[branch].z - lowers[branch].z;
        return x * y + y * z + z * x;
    };
    // The number of triangles of a leaf, or of a branch of few; -1: it has more. With a place they are listed there.
    auto triangles_of = [&](int branch, int place) -> int {
        int waiting[LEAF] = {branch}, size = 1, count = 0;
        while (size > 0) {
            const int at = waiting[--size];
            if (lowers[at].b) {
                for (int k = lowers[at].i; k < (int)uppers[at].i; ++k, ++count)
                    if (place >= 0) out_faces.data[place + count] = mesh.bvh.primitive_indices[k] << 1;
                if (count + size > LEAF && at != branch) return -1;
            } else {
                if (count + size + 2 > LEAF) return -1;
                waiting[size++] = uppers[at].i;
                waiting[size++] = lowers[at].i;
            }
        }
        return count;
    };
    int branches[4] = {out_branches.data[node]}, count = 1;
    while (count < 4) {
        int best = -1;
        bool best_divided = false;
        for (int k = 0; k < count; ++k) {
            if (lowers[branches[k]].b) continue;
            const bool divided = triangles_of(branches[k], -1) < 0;
            const bool larger = best < 0 || area(branches[k]) > area(branches[best]);
            if (best < 0 || divided > best_divided || (divided == best_divided && larger)) {
                best = k;
                best_divided = divided;
            }
        }
        if (best < 0) break;
        const int opened = branches[best];
        branches[best] = lowers[opened].i;
        branches[count++] = uppers[opened].i;
    }
    int nodes = 0;
    for (int k = 0; k < count; ++k) nodes += triangles_of(branches[k], -1) < 0;
    int next = taken(0, nodes);
    for (int k = 0; k < 4; ++k) {
        int source = -1, child = ~0;
        const int triangles = k < count ? triangles_of(branches[k], -1) : 0;
        if (triangles != 0) source = branches[k];
        if (triangles < 0) {
            child = next++;
            out_branches.data[child] = branches[k];
        } else if (triangles > 0) {
            const int first = taken(1, triangles);
            triangles_of(branches[k], first);
            out_faces.data[first + triangles - 1] |= 1;
            child = ~first;
        }
        out_sources.data[4 * node + k] = source;
        out_children.data[4 * node + k] = child;
    }
""".replace("LEAF", str(LEAF))
)
def lay_out_node(
    node: int,
    mesh_id: wp.uint64,
    out_counts: wp.array(dtype=int),
    out_branches: wp.array(dtype=int),
    out_sources: wp.array(dtype=int),
    out_children: wp.array(dtype=int),
    out_faces: wp.array(dtype=int),
): ...


@wp.kernel
def lay_out_kernel(
    first: int,
    level: int,
    mesh_id: wp.uint64,
    levels: wp.array(dtype=int),
    out_counts: wp.array(dtype=int),
    out_branches: wp.array(dtype=int),
    out_sources: wp.array(dtype=int),
    out_children: wp.array(dtype=int),
    out_faces: wp.array(dtype=int),
):
    """One thread per node that a level may have: its children, of which nodes become the next level's; they begin at `levels`."""
    node = levels[level] + first + wp.tid()
    if node >= levels[level + 1]:
        return
    if node == 0:
        out_branches[0] = root_of(mesh_id)
    lay_out_node(node, mesh_id, out_counts, out_branches, out_sources, out_children, out_faces)


@wp.func_native(
    _TREE
    + r"""
    const int nodes = sources.shape[0] / 4;
    if (element >= nodes) {
        const int at = element - nodes, face = faces.data[at] >> 1;
        for (int corner = 0; corner < 3; ++corner)
            for (int axis = 0; axis < 3; ++axis)
                ((float*)out_triangles.data)[12 * at + 4 * corner + axis] =
                    mesh.points.data[mesh.indices.data[3 * face + corner]][axis];
        out_triangles.data[12 * at + 3] = faces.data[at];
        return;
    }
    union Word { float number; unsigned bits; };
    Word* words = (Word*)out_nodes.data + 16 * element;
    const int* source = sources.data + 4 * element;
    words[3].bits = 0u;
    for (int axis = 0; axis < 3; ++axis) {
        float low = 3.0e38f, high = -3.0e38f;
        for (int k = 0; k < 4; ++k) {
            if (source[k] < 0) continue;
            const float least = (&lowers[source[k]].x)[axis], most = (&uppers[source[k]].x)[axis];
            low = least < low ? least : low;
            high = most > high ? most : high;
        }
        // A box of bytes is larger than what is in it by a quarter of a step at least, on a grid that begins a step before. A
        // step is 4 roundings of a coordinate or more: more than a ray's distances are off at this place.
        const float far = -low > high ? -low : high;
        Word step;
        step.number = (high - low) / 253.0f;
        step.number = step.number > 4.8e-7f * far ? step.number : 4.8e-7f * far;
        step.number = step.number > 1.0e-30f ? step.number : 1.0e-30f;
        const unsigned exponent = (step.bits + 0x7fffffu) >> 23;
        step.bits = exponent << 23;
        const float corner = low - step.number;
        unsigned from = 0u, to = 0u;
        for (int k = 0; k < 4; ++k) {
            int least = 255, most = 0;  // no child: inside out, nothing meets it
            if (source[k] >= 0) {
                least = (int)(((&lowers[source[k]].x)[axis] - corner) / step.number - 0.25f);
                most = (int)(((&uppers[source[k]].x)[axis] - corner) / step.number + 1.25f);
                least = least < 0 ? 0 : least;
                most = most > 255 ? 255 : most;
            }
            from |= (unsigned)least << 8 * k;
            to |= (unsigned)most << 8 * k;
        }
        words[axis].number = corner;
        words[3].bits |= exponent << 8 * axis;
        words[8 + axis].bits = from;
        words[12 + axis].bits = to;
    }
    for (int k = 0; k < 4; ++k) words[4 + k].bits = (unsigned)children.data[4 * element + k];
"""
)
def fit_element(
    element: int,
    mesh_id: wp.uint64,
    sources: wp.array(dtype=int),
    children: wp.array(dtype=int),
    faces: wp.array(dtype=int),
    out_nodes: wp.array(dtype=int),
    out_triangles: wp.array(dtype=int),
): ...


@wp.kernel
def fit_kernel(
    first: int,
    mesh_id: wp.uint64,
    sources: wp.array(dtype=int),
    children: wp.array(dtype=int),
    faces: wp.array(dtype=int),
    out_nodes: wp.array(dtype=int),
    out_triangles: wp.array(dtype=int),
):
    """One thread per node, then one per triangle."""
    fit_element(first + wp.tid(), mesh_id, sources, children, faces, out_nodes, out_triangles)


class RayTree:
    """The tree of a mesh with four children a node.

    Attributes:
        id: Handle for `ray_query.py`; valid while this object and the mesh live.
        is_whole: It has no more than `DEEPEST` levels; else it must not be walked.
    """

    def __init__(self, mesh: wp.Mesh):
        """Lay the tree out after that of `mesh`, a mesh with a triangle at least, and fit it."""
        self._mesh, device = mesh, mesh.device
        triangles = len(mesh.indices) // 3
        most = triangles // (LEAF + 1) + 1  # nodes of a level: but for the first, each is of more triangles than a leaf
        levels = wp.array([0, 1] + DEEPEST * [0], dtype=int, device=device)  # the first node of each
        counts = wp.array([1, 0], dtype=int, device=device)  # nodes; triangles in leaves
        branches = wp.empty(triangles, dtype=int, device=device)  # of Warp's tree, what nodes are made of
        sources, children = (wp.empty(WIDTH * triangles, dtype=int, device=device) for _ in range(2))
        self._faces = wp.empty(triangles, dtype=int, device=device)
        for level in range(DEEPEST):
            outputs = [counts, branches, sources, children, self._faces]
            count = min(WIDTH**level, most)
            launch(lay_out_kernel, count, [level, wp.uint64(mesh.id), levels, *outputs], device, 1)
            wp.copy(levels, counts, level + 2, 0, 1)
        # Read once, at the end: a device answers no sooner than it has done all that it was asked before.
        starts = levels.numpy()
        end = int(starts[-1])
        self.is_whole = bool(starts[-2] == end)
        self._sources, self._children = (wp.clone(each[: WIDTH * end]) for each in (sources, children))
        self._nodes = wp.zeros(NODE_WORDS * end, dtype=int, device=device)
        self._triangles = wp.zeros(TRIANGLE_WORDS * triangles, dtype=int, device=device)
        self._header = wp.array([self._nodes.ptr, self._triangles.ptr], dtype=wp.uint64, device=device)
        self.id = self._header.ptr
        if self.is_whole:
            self.fit()

    def fit(self) -> None:
        """Take over the boxes and points of the mesh, after it was refitted."""
        laid_out = [self._sources, self._children, self._faces]
        inputs = [wp.uint64(self._mesh.id), *laid_out, self._nodes, self._triangles]
        launch(fit_kernel, len(self._sources) // WIDTH + len(self._faces), inputs, self._mesh.device)
