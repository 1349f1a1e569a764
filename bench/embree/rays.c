/* Embree traces the same rays one by one. Arguments: a file of triangles and rays, and whether the tree is to be robust.
   For every line "closest" or "any" on its standard input it prints CPU seconds of this thread, the number of hits and
   the sum of their distances. First it prints its version, seconds and bytes of the tree. */
#include <embree3/rtcore.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

static long long bytes = 0;

static bool count(void *unused, ssize_t change, bool post) {
    (void)unused, (void)post;
    bytes += change;
    return true;
}

static double seconds(clockid_t clock) {
    struct timespec now;
    clock_gettime(clock, &now);
    return now.tv_sec + 1e-9 * now.tv_nsec;
}

int main(int argc, char **argv) {
    FILE *file = argc == 2 ? fopen(argv[1], "rb") : NULL;
    unsigned size[2];
    if (!file || fread(size, 4, 2, file) != 2) return fprintf(stderr, "no file of triangles and rays\n"), 2;
    unsigned triangles = size[0], rays = size[1];
    RTCDevice device = rtcNewDevice("threads=1");
    rtcSetDeviceMemoryMonitorFunction(device, count, NULL);
    RTCGeometry geometry = rtcNewGeometry(device, RTC_GEOMETRY_TYPE_TRIANGLE);
    float *corners = rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, 12, 3 * triangles);
    unsigned *indices = rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3, 12, triangles);
    float *data = malloc(28ull * rays);
    if (fread(corners, 36, triangles, file) != triangles || fread(data, 28, rays, file) != rays) return 2;
    for (unsigned i = 0; i < 3 * triangles; i++) indices[i] = i;
    rtcCommitGeometry(geometry);
    RTCScene scene = rtcNewScene(device);
    rtcAttachGeometry(scene, geometry);
    long long before = bytes;
    double start = seconds(CLOCK_PROCESS_CPUTIME_ID);
    rtcCommitScene(scene);
    printf("%s %g %lld\n", RTC_VERSION_STRING, seconds(CLOCK_PROCESS_CPUTIME_ID) - start, bytes - before);
    fflush(stdout);
    char line[32];
    while (fgets(line, sizeof line, stdin)) {
        int any = !strncmp(line, "any", 3);
        unsigned hits = 0;
        double sum = 0;
        struct RTCIntersectContext context;
        rtcInitIntersectContext(&context);
        start = seconds(CLOCK_THREAD_CPUTIME_ID);
        for (unsigned i = 0; i < rays; i++) {
            const float *r = data + 7ull * i;
            struct RTCRayHit hit = {.ray = {.org_x = r[0], .org_y = r[1], .org_z = r[2], .dir_x = r[3], .dir_y = r[4],
                .dir_z = r[5], .tnear = 0, .tfar = any ? r[6] : INFINITY, .mask = -1}};
            if (any) {
                rtcOccluded1(scene, &context, &hit.ray);
                hits += hit.ray.tfar < 0;
            } else {
                hit.hit.geomID = RTC_INVALID_GEOMETRY_ID;
                rtcIntersect1(scene, &context, &hit);
                if (hit.hit.geomID != RTC_INVALID_GEOMETRY_ID) hits++, sum += hit.ray.tfar;
            }
        }
        printf("%.9g %u %.9g\n", seconds(CLOCK_THREAD_CPUTIME_ID) - start, hits, sum);
        fflush(stdout);
    }
    return 0;
}
