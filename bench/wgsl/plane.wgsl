// What both passes of a hemisphere by rasterisation read. SIZE (pixels of a plane's edge), COLUMNS (planes side by side in the
// picture), CELLS (of a triangle's edge) and HALF (slope of a plane's edge) come before this. The twin is src/plane.rs.

// Where a record looks from: a frame with z along its normal.
struct Eye {
    position: vec3f,
    // Least height above the surface that is drawn, world length.
    near: f32,
    x: vec3f,
    pad0: u32,
    y: vec3f,
    pad1: u32,
    z: vec3f,
    pad2: u32,
}

@group(0) @binding(0) var<storage, read> eyes: array<Eye>;
// Corners of triangles, one after another.
@group(0) @binding(1) var<storage, read> corners: array<vec4f>;
