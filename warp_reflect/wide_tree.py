"""A triangle BVH of Warp with eight children a node, and its triangles' corners where they are read: what packets walk down.

Warp's tree has two children a node. Here the children of a node's largest branches take its place until there are eight,
so that one vector operation asks them all (Wald, Benthin and Boulos, Getting Rid of Packets, RT 2008; Ernst and Greiner,
Multi Bounding Volume Hierarchies, RT 2008). The leaves are Warp's own, with their own boxes: a ray asks the same triangles.
Only for the CPU: the layout of Warp's tree is that of warp/native/bvh.h.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import vector
from warp_reflect.launch import launch

wp.set_module_options({"enable_backward": False})

WIDTH = 8  # children of a node
# 4 bytes each, on whole cache lines of 16: the least x of all children, the least y and z, the most x, y and z; the children.
NODE_WORDS = 64
# x of the first corner of four triangles that lie together, y, z, then the other corners; the triangles (-1 none); 1 where the
# leaf goes on with the next chunk.
CHUNK_WORDS = 48
FACE_INTS = 8  # of a chunk while it is laid out: its last numbers
LINE = 64  # bytes of a cache line
FIT_SPLIT_MIN = 2048  # nodes and chunks; what one of them costs is a few dozen numbers copied


@wp.func_native(
    vector.snippet(r"""
    const wp::Mesh& mesh = *(const wp::Mesh*)mesh_id;
    const wp::BVHPackedNodeHalf* lowers = mesh.bvh.node_lowers;
    const wp::BVHPackedNodeHalf* uppers = mesh.bvh.node_uppers;
    int node_count = 0, chunk_count = 0, waiting_count = 0;
    // A branch waits at most once a level for each of its siblings; Warp's builders end one short of its stack, and a
    // tree of groups has such trees under another.
    constexpr int DEEPEST = 2 * BVH_QUERY_STACK_SIZE * 8;
    int waiting[DEEPEST], place[DEEPEST];
    auto area = [&](int node) -> float {
        const float x = uppers[node].x - lowers[node].x, y = uppers[node].y - lowers[node].y;
        const float z = uppers[node].z - lowers[node].z;
        return x * y + y * z + z * x;
    };
    auto lay_out = [&](int node, int at, const int* children, int count) {
        for (int k = 0; k < 8; ++k) {
            int child = 0, source = -1;
            if (k < count) {
                source = children[k];
                const int begin = lowers[source].i, end = uppers[source].i;
                if (lowers[source].b) {
                    child = ~chunk_count;
                    for (int first = begin; first < end || first == begin; first += 4) {
                        for (int l = 0; write && l < 4; ++l)
                            out_faces.data[8 * chunk_count + l] = first + l < end ? mesh.bvh.primitive_indices[first + l] : -1;
                        if (write) out_faces.data[8 * chunk_count + 4] = first + 4 < end;
                        ++chunk_count;
                    }
                } else if (waiting_count < DEEPEST) {
                    child = node_count++;
                    waiting[waiting_count] = source;
                    place[waiting_count++] = child;
                }
            }
            if (!write) continue;
            out_children.data[8 * at + k] = child;
            out_sources.data[8 * at + k] = node < 0 && source >= 0 ? -2 : source;
        }
    };
    const int root = *mesh.bvh.root;
    node_count = 1;
    if (lowers[root].b) {
        lay_out(-1, 0, &root, 1);
    } else {
        waiting[waiting_count] = root;
        place[waiting_count++] = 0;
    }
    while (waiting_count > 0) {
        const int node = waiting[--waiting_count], at = place[waiting_count];
        int children[8] = {(int)lowers[node].i, (int)uppers[node].i}, count = 2;
        while (count < 8) {
            int best = -1;
            for (int k = 0; k < count; ++k)
                if (!lowers[children[k]].b && (best < 0 || area(children[k]) > area(children[best]))) best = k;
            if (best < 0) break;
            const int taken = children[best];
            children[best] = lowers[taken].i;
            children[count++] = uppers[taken].i;
        }
        lay_out(node, at, children, count);
    }
    out_counts.data[0] = node_count;
    out_counts.data[1] = chunk_count;
""")
)
def lay_out_tree(
    mesh_id: wp.uint64,
    write: int,
    out_counts: wp.array(dtype=int),
    out_children: wp.array(dtype=int),
    out_sources: wp.array(dtype=int),
    out_faces: wp.array(dtype=int),
): ...


@wp.kernel
def lay_out_kernel(
    first: int,
    mesh_id: wp.uint64,
    write: int,
    out_counts: wp.array(dtype=int),
    out_children: wp.array(dtype=int),
    out_sources: wp.array(dtype=int),
    out_faces: wp.array(dtype=int),
):
    """One thread; write 0: only the counts of nodes and chunks."""
    lay_out_tree(mesh_id, write, out_counts, out_children, out_sources, out_faces)


@wp.func_native(
    vector.snippet(r"""
    const wp::Mesh& mesh = *(const wp::Mesh*)mesh_id;
    const int node_count = sources.shape[0] / 8;
    if (element < node_count) {
        float* box = out_nodes.data + 64 * element;
        __builtin_memcpy(box + 48, children.data + 8 * element, 32);
        for (int k = 0; k < 8; ++k) {
            const int source = sources.data[8 * element + k];
            // No child: a box inside out, which nothing meets. A root that is a leaf: nothing passes by it.
            const float all = source == -2 ? -3.0e38f : 3.0e38f;
            for (int axis = 0; axis < 3; ++axis) {
                box[8 * axis + k] = source < 0 ? all : (&mesh.bvh.node_lowers[source].x)[axis];
                box[24 + 8 * axis + k] = source < 0 ? -all : (&mesh.bvh.node_uppers[source].x)[axis];
            }
        }
        return;
    }
    const int chunk = element - node_count;
    float* numbers = out_chunks.data + 48 * chunk;
    __builtin_memcpy(numbers + 36, faces.data + 8 * chunk, 32);
    for (int k = 0; k < 4; ++k) {
        const int face = faces.data[8 * chunk + k];
        for (int corner = 0; corner < 3; ++corner)
            for (int axis = 0; axis < 3; ++axis)
                numbers[12 * corner + 4 * axis + k] =
                    face < 0 ? 0.0f : mesh.points.data[mesh.indices.data[3 * face + corner]][axis];
    }
""")
)
def fit_element(
    element: int,
    mesh_id: wp.uint64,
    children: wp.array(dtype=int),
    sources: wp.array(dtype=int),
    faces: wp.array(dtype=int),
    out_nodes: wp.array(dtype=float),
    out_chunks: wp.array(dtype=float),
): ...


@wp.kernel
def fit_kernel(
    first: int,
    mesh_id: wp.uint64,
    children: wp.array(dtype=int),
    sources: wp.array(dtype=int),
    faces: wp.array(dtype=int),
    out_nodes: wp.array(dtype=float),
    out_chunks: wp.array(dtype=float),
):
    """One thread per node, then one per chunk of triangles."""
    fit_element(first + wp.tid(), mesh_id, children, sources, faces, out_nodes, out_chunks)


@wp.func_native(
    vector.snippet(r"""
    // A node's children come after it.
    for (int node = children.shape[0] / 8 - 1; node >= 0; --node) {
        int whole = 0;
        for (int k = 0; k < 8; ++k) {
            const int child = children.data[8 * node + k];
            bool all = child <= 0 || out_branches.data[child] == 255;
            for (int chunk = ~child; child < 0; ++chunk) {
                for (int l = 0; l < 4; ++l) {
                    const int face = faces.data[8 * chunk + l];
                    all &= face < 0 || (face >= first_face && face < end_face);
                }
                if (!faces.data[8 * chunk + 4]) break;
            }
            whole |= all << k;
        }
        out_branches.data[node] = (unsigned char)whole;
    }
""")
)
def mark_branches(
    first_face: int,
    end_face: int,
    children: wp.array(dtype=int),
    faces: wp.array(dtype=int),
    out_branches: wp.array(dtype=wp.uint8),
): ...


@wp.kernel
def mark_branches_kernel(
    first: int,
    first_face: int,
    end_face: int,
    children: wp.array(dtype=int),
    faces: wp.array(dtype=int),
    out_branches: wp.array(dtype=wp.uint8),
):
    """One thread."""
    mark_branches(first_face, end_face, children, faces, out_branches)


def _lines(count: int) -> wp.array:
    """Numbers that begin with a cache line."""
    words = LINE // 4
    held = wp.zeros(count + words, dtype=float, device="cpu")
    first = -held.ptr % LINE // 4
    return held[first : first + count]


class WideTree:
    """The tree of a mesh with eight children a node.

    Attributes:
        id: Handle for the snippets of `wide_packets.py`; valid while this object and the mesh live.
    """

    def __init__(self, mesh: wp.Mesh, threads: int = 0):
        """Lay the tree out after that of `mesh`, a mesh on the CPU with a triangle at least, and fit it."""
        self._mesh = mesh
        none, counts = wp.zeros(0, dtype=int, device="cpu"), wp.zeros(2, dtype=int, device="cpu")
        launch(lay_out_kernel, 1, [wp.uint64(mesh.id), 0, counts, none, none, none], "cpu", 1)
        nodes, chunks = (int(count) for count in counts.numpy())
        self._children, self._sources = (wp.empty(WIDTH * nodes, dtype=int, device="cpu") for _ in range(2))
        self._faces = wp.zeros(FACE_INTS * chunks, dtype=int, device="cpu")
        launch(lay_out_kernel, 1, [wp.uint64(mesh.id), 1, counts, self._children, self._sources, self._faces], "cpu", 1)
        self._nodes, self._chunks = _lines(NODE_WORDS * nodes), _lines(CHUNK_WORDS * chunks)
        self._elements = nodes + chunks
        self._header = wp.array([mesh.id, self._nodes.ptr, self._chunks.ptr], dtype=wp.uint64, device="cpu")
        self._branches: dict[tuple[int, int], wp.array] = {}
        self.id = self._header.ptr
        self.fit(threads)

    def branches_of(self, first: int, count: int) -> wp.array:
        """uint8 of each node, a bit for each child with no other triangles below it than `count` from `first` on."""
        if (first, count) not in self._branches:
            made = wp.empty(len(self._children) // WIDTH, dtype=wp.uint8, device="cpu")
            launch(mark_branches_kernel, 1, [first, first + count, self._children, self._faces, made], "cpu", 1)
            self._branches[first, count] = made
        return self._branches[first, count]

    def fit(self, threads: int = 0) -> None:
        """Take over the boxes and points of the mesh, after it was refitted."""
        laid_out = [self._children, self._sources, self._faces]
        inputs = [wp.uint64(self._mesh.id), *laid_out, self._nodes, self._chunks]
        launch(fit_kernel, self._elements, inputs, "cpu", threads, split_min=FIT_SPLIT_MIN)
