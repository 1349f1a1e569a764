// Irradiance of each record: what its pixels see, by their weights. One group of threads a record.

// Radiance of the triangles' cells.
@group(0) @binding(2) var<storage, read> glow: array<vec4f>;
// Projected solid angle each pixel stands for.
@group(0) @binding(3) var<storage, read> weights: array<f32>;
// What rasterise.wgsl drew.
@group(0) @binding(4) var triangles: texture_2d<u32>;
@group(0) @binding(5) var<storage, read_write> irradiance: array<vec4f>;

const THREADS: u32 = 64u;

var<workgroup> sums: array<vec4f, THREADS>;

// Radiance of a triangle where the ray from an eye meets its plane.
fn shine(triangle: u32, eye: vec3f, direction: vec3f) -> vec4f {
    let a = corners[3u * triangle].xyz;
    let b = corners[3u * triangle + 1u].xyz - a;
    let c = corners[3u * triangle + 2u].xyz - a;
    let p = cross(direction, c);
    let away = eye - a;
    let scale = 1.0 / dot(b, p);
    let uv = vec2f(dot(away, p), dot(direction, cross(away, b))) * scale;
    let cell = min(vec2u(max(uv, vec2f(0.0)) * f32(CELLS)), vec2u(CELLS - 1u));
    return glow[(triangle * CELLS + cell.y) * CELLS + cell.x];
}

@compute @workgroup_size(THREADS)
fn integrate(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) thread: u32) {
    let record = group.x;
    let eye = eyes[record];
    let corner = vec2u(record % COLUMNS, record / COLUMNS) * SIZE;
    var sum = vec4f(0.0);
    for (var pixel = thread; pixel < SIZE * SIZE; pixel += THREADS) {
        let at = vec2u(pixel % SIZE, pixel / SIZE);
        let triangle = textureLoad(triangles, corner + at, 0).x;
        if triangle != 0u {
            let slope = ((vec2f(at) + 0.5) / f32(SIZE) * 2.0 - 1.0) * vec2f(HALF, -HALF);
            sum += shine(triangle - 1u, eye.position, eye.x * slope.x + eye.y * slope.y + eye.z) * weights[pixel];
        }
    }
    sums[thread] = sum;
    for (var half = THREADS / 2u; half > 0u; half /= 2u) {
        workgroupBarrier();
        if thread < half {
            sums[thread] += sums[thread + half];
        }
    }
    if thread == 0u {
        irradiance[record] = sums[0];
    }
}
