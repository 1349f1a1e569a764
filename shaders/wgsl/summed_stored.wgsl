// The sums that sum.wgsl stored.
@group(0) @binding(2) var<storage, read> sums: array<vec4f>;

fn summed(at: vec2u, which: u32) -> vec4f {
    return sums[3u * (at.y * view.width + at.x) + which];
}
