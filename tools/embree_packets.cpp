// A frame's eye rays and mirror rays through Embree 3 in packets of 16, on any number of threads: hits, no shading.
// What Embree itself can do, where a program is written for it; `embree_packets.py` builds and drives it.

#include <embree3/rtcore.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstring>
#include <thread>
#include <vector>

namespace {

constexpr int SIDE = 4, LANES = SIDE * SIDE;  // a packet is a square of pixels
constexpr int NOT_MIRRORED = -2, MISSED = -1;

// A patch whose normals are those of x^2 + y^2 + a z^2 + b z = const in its unit frame.
struct Quadric {
    float unit_from_scene[12], a, b;
};

struct Camera {
    float eye[3], forward[3], right[3], up[3];  // right and up: of one pixel
    float cx, cy;
    int width, height, orthographic;
};

struct Peer {
    RTCDevice device;
    RTCScene scene;
    std::vector<float> points, normals;
    std::vector<int> triangles, normal_index, patch;  // patch: of mirrors, -1 elsewhere
    std::vector<Quadric> quadrics;
    std::vector<int> quadric_of_patch;
};

void mirrored(const Peer& peer, const RTCRayHit16& seen, int lane, float step, RTCRayHit16& onward) {
    const int triangle = seen.hit.primID[lane];
    const int* corner = &peer.triangles[3 * triangle];
    const float u = seen.hit.u[lane], v = seen.hit.v[lane], w = 1.0f - u - v;
    const float d[3] = {seen.ray.dir_x[lane], seen.ray.dir_y[lane], seen.ray.dir_z[lane]};
    const float *a = &peer.points[3 * corner[0]], *b = &peer.points[3 * corner[1]], *c = &peer.points[3 * corner[2]];
    float p[3], n[3];
    for (int k = 0; k < 3; ++k) p[k] = w * a[k] + u * b[k] + v * c[k];
    const int quadric = peer.quadric_of_patch[peer.patch[triangle]];
    const int* index = &peer.normal_index[3 * triangle];
    if (quadric >= 0) {
        const Quadric& shape = peer.quadrics[quadric];
        const float* m = shape.unit_from_scene;
        float q[3];
        for (int k = 0; k < 3; ++k) q[k] = m[4 * k] * p[0] + m[4 * k + 1] * p[1] + m[4 * k + 2] * p[2] + m[4 * k + 3];
        const float g[3] = {q[0], q[1], shape.a * q[2] + 0.5f * shape.b};
        for (int k = 0; k < 3; ++k) n[k] = m[k] * g[0] + m[4 + k] * g[1] + m[8 + k] * g[2];
    } else if (index[0] >= 0) {
        const float* r[3] = {&peer.normals[3 * index[0]], &peer.normals[3 * index[1]], &peer.normals[3 * index[2]]};
        for (int k = 0; k < 3; ++k) n[k] = w * r[0][k] + u * r[1][k] + v * r[2][k];
    } else {
        const float e[3] = {b[0] - a[0], b[1] - a[1], b[2] - a[2]}, f[3] = {c[0] - a[0], c[1] - a[1], c[2] - a[2]};
        for (int k = 0; k < 3; ++k) n[k] = e[(k + 1) % 3] * f[(k + 2) % 3] - e[(k + 2) % 3] * f[(k + 1) % 3];
    }
    const float inverse = 1.0f / std::sqrt(std::max(n[0] * n[0] + n[1] * n[1] + n[2] * n[2], 1.0e-30f));
    for (float& x : n) x *= inverse;
    const float cosine = n[0] * d[0] + n[1] * d[1] + n[2] * d[2], away = cosine > 0.0f ? -step : step;
    onward.ray.org_x[lane] = p[0] + away * n[0];
    onward.ray.org_y[lane] = p[1] + away * n[1];
    onward.ray.org_z[lane] = p[2] + away * n[2];
    onward.ray.dir_x[lane] = d[0] - 2.0f * cosine * n[0];
    onward.ray.dir_y[lane] = d[1] - 2.0f * cosine * n[1];
    onward.ray.dir_z[lane] = d[2] - 2.0f * cosine * n[2];
}

void begin(RTCRayHit16& rays) {
    for (int lane = 0; lane < LANES; ++lane) {
        rays.ray.tnear[lane] = rays.ray.time[lane] = 0.0f;
        rays.ray.tfar[lane] = INFINITY;
        rays.ray.mask[lane] = -1u;
        rays.ray.id[lane] = rays.ray.flags[lane] = 0;
        rays.hit.geomID[lane] = rays.hit.instID[0][lane] = RTC_INVALID_GEOMETRY_ID;
    }
}

void packet(const Peer& peer, const Camera& camera, int first_x, int first_y, float step, int* out_triangle) {
    alignas(64) int valid[LANES], reflects[LANES];
    alignas(64) RTCRayHit16 seen, onward;
    begin(seen);
    for (int lane = 0; lane < LANES; ++lane) {
        const int x = first_x + lane % SIDE, y = first_y + lane / SIDE;
        valid[lane] = x < camera.width && y < camera.height ? -1 : 0;
        const float across = x + 0.5f - camera.cx, down = camera.cy - (y + 0.5f);
        float o[3], d[3];
        for (int k = 0; k < 3; ++k) {
            const float aside = across * camera.right[k] + down * camera.up[k];
            o[k] = camera.eye[k] + (camera.orthographic ? aside : 0.0f);
            d[k] = camera.forward[k] + (camera.orthographic ? 0.0f : aside);
        }
        const float inverse = 1.0f / std::sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
        seen.ray.org_x[lane] = o[0]; seen.ray.org_y[lane] = o[1]; seen.ray.org_z[lane] = o[2];
        seen.ray.dir_x[lane] = d[0] * inverse; seen.ray.dir_y[lane] = d[1] * inverse; seen.ray.dir_z[lane] = d[2] * inverse;
    }
    RTCIntersectContext context;
    rtcInitIntersectContext(&context);
    context.flags = RTC_INTERSECT_CONTEXT_FLAG_COHERENT;
    rtcIntersect16(valid, peer.scene, &context, &seen);
    int any = 0;
    for (int lane = 0; lane < LANES; ++lane) {
        const bool hit = valid[lane] && seen.hit.geomID[lane] != RTC_INVALID_GEOMETRY_ID;
        reflects[lane] = hit && peer.patch[seen.hit.primID[lane]] >= 0 ? -1 : 0;
        any |= reflects[lane];
    }
    if (any) {
        begin(onward);
        for (int lane = 0; lane < LANES; ++lane)
            if (reflects[lane]) mirrored(peer, seen, lane, step, onward);
        rtcInitIntersectContext(&context);
        rtcIntersect16(reflects, peer.scene, &context, &onward);
    }
    for (int lane = 0; lane < LANES; ++lane) {
        if (!valid[lane]) continue;
        int found = NOT_MIRRORED;
        if (reflects[lane])
            found = onward.hit.geomID[lane] != RTC_INVALID_GEOMETRY_ID ? (int)onward.hit.primID[lane] : MISSED;
        out_triangle[(first_y + lane / SIDE) * camera.width + first_x + lane % SIDE] = found;
    }
}

}  // namespace

extern "C" {

void peer_build(Peer* peer);

Peer* peer_open(const float* points, int point_count, const int* triangles, int triangle_count, const float* normals,
                int normal_count, const int* normal_index, const int* patch, const Quadric* quadrics, int quadric_count,
                const int* quadric_of_patch, int patch_count) {
    Peer* peer = new Peer;
    peer->points.assign(points, points + 3 * point_count);
    peer->triangles.assign(triangles, triangles + 3 * triangle_count);
    peer->normals.assign(normals, normals + 3 * normal_count);
    peer->normal_index.assign(normal_index, normal_index + 3 * triangle_count);
    peer->patch.assign(patch, patch + triangle_count);
    peer->quadrics.assign(quadrics, quadrics + quadric_count);
    peer->quadric_of_patch.assign(quadric_of_patch, quadric_of_patch + patch_count);
    peer->device = rtcNewDevice(nullptr);
    peer->scene = nullptr;
    peer_build(peer);
    return peer;
}

// The tree, from where the points are.
void peer_build(Peer* peer) {
    if (peer->scene) rtcReleaseScene(peer->scene);
    const size_t point_count = peer->points.size() / 3, triangle_count = peer->triangles.size() / 3;
    peer->scene = rtcNewScene(peer->device);
    RTCGeometry geometry = rtcNewGeometry(peer->device, RTC_GEOMETRY_TYPE_TRIANGLE);
    std::memcpy(rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, 12, point_count),
                peer->points.data(), sizeof(float) * 3 * point_count);
    std::memcpy(rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3, 12, triangle_count),
                peer->triangles.data(), sizeof(int) * 3 * triangle_count);
    rtcCommitGeometry(geometry);
    rtcAttachGeometry(peer->scene, geometry);
    rtcReleaseGeometry(geometry);
    rtcCommitScene(peer->scene);
}

int peer_has_packets(const Peer* peer) { return rtcGetDeviceProperty(peer->device, RTC_DEVICE_PROPERTY_NATIVE_RAY16_SUPPORTED); }

void peer_trace(const Peer* peer, const Camera* camera, float step, int threads, int* out_triangle) {
    std::atomic<int> next{0};
    auto work = [&] {
        for (int y; (y = SIDE * next++) < camera->height;)
            for (int x = 0; x < camera->width; x += SIDE) packet(*peer, *camera, x, y, step, out_triangle);
    };
    std::vector<std::thread> others;
    for (int k = 1; k < threads; ++k) others.emplace_back(work);
    work();
    for (std::thread& other : others) other.join();
}

void peer_close(Peer* peer) {
    rtcReleaseScene(peer->scene);
    rtcReleaseDevice(peer->device);
    delete peer;
}
}
