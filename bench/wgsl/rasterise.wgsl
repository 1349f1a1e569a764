// Draws what a record sees through its plane (Gautron 2005, section 5.2): each pixel gets its triangle's number plus one.

struct Seen {
    @builtin(position) position: vec4f,
    @location(0) @interpolate(flat) triangle: u32,
}

@vertex
fn project(@builtin(vertex_index) corner: u32, @builtin(instance_index) record: u32) -> Seen {
    let eye = eyes[record];
    let away = corners[corner].xyz - eye.position;
    // Depth is near / z: as precise far away as close by.
    let place = vec4f(dot(away, eye.x) / HALF, dot(away, eye.y) / HALF, eye.near, dot(away, eye.z));
    return Seen(place, corner / 3u + 1u);
}

@fragment
fn rasterise(seen: Seen) -> @location(0) u32 {
    return seen.triangle;
}
