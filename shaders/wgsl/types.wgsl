// What all passes read. Each struct has a twin in src/layout.rs, held equal by a test.

// Camera and region: pixels count from the region's corner.
struct View {
    eye: vec3f,
    // 1 for parallel rays.
    parallel: u32,
    forward: vec3f,
    // Of the region, in pixels.
    width: u32,
    right: vec3f,
    height: u32,
    down: vec3f,
    pad: u32,
    // Pixels per unit of slope, or of length where rays are parallel: across, down.
    scale: vec2f,
    // Pixel coordinates of what the eye looks straight at.
    centre: vec2f,
}

// Where a record lies and how far it counts.
struct Site {
    position: vec3f,
    radius: f32,
    normal: vec3f,
    a: f32,
    // (xx, xy, yy) of M in the normal's frame.
    ellipse: vec3f,
    limit: f32,
    noise: f32,
    pad0: u32,
    pad1: u32,
    pad2: u32,
}

// Where a pixel asks.
struct Point {
    position: vec3f,
    // 0: nowhere; 1: records of irradiance; else the order of records of radiance.
    kind: u32,
    normal: vec3f,
    // Which lobe of its order.
    lobe: u32,
    shading: vec3f,
    pad: u32,
}

// What a pixel is told.
struct Answer {
    irradiance: vec3f,
    noise: f32,
    radiance: vec3f,
    records: f32,
}

struct Frame {
    x: vec3f,
    y: vec3f,
}

// Duff et al. 2017, as cache_core::math::Frame.
fn frame(n: vec3f) -> Frame {
    // The sign of -0 counts.
    let s = select(1.0, -1.0, (bitcast<u32>(n.z) >> 31u) == 1u);
    let a = -1.0 / (s + n.z);
    let b = n.x * n.y * a;
    return Frame(vec3f(1.0 + s * n.x * n.x * a, s * b, -s * n.x), vec3f(b, s + n.y * n.y * a, -n.y));
}
