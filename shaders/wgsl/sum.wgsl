// The same sums without blending, for adapters that cannot add floats: a group of threads has the pixels of a tile, and goes
// through the records that reach the tile in the order of their ids.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> sites: array<Site>;
@group(0) @binding(2) var<storage, read> values: array<f32>;
@group(0) @binding(3) var<storage, read> points: array<Point>;
// Of each tile where its records begin in `reached`; one more at the end.
@group(0) @binding(4) var<storage, read> tiles: array<u32>;
@group(0) @binding(5) var<storage, read> reached: array<u32>;
// Three for each pixel, as the targets of splat.wgsl.
@group(0) @binding(6) var<storage, read_write> sums: array<vec4f>;

@compute @workgroup_size(16, 16)
fn sum(@builtin(global_invocation_id) at: vec3u, @builtin(workgroup_id) group: vec3u) {
    if at.x >= view.width || at.y >= view.height {
        return;
    }
    let pixel = at.y * view.width + at.x;
    let point = points[pixel];
    if point.kind != KIND {
        return;
    }
    let tile = group.y * ((view.width + 15u) / 16u) + group.x;
    var irradiance = sums[3u * pixel];
    var noise = sums[3u * pixel + 1u];
    var radiance = sums[3u * pixel + 2u];
    for (var i = tiles[tile]; i < tiles[tile + 1u]; i++) {
        let record = reached[i];
        let site = sites[record];
        let weight = weigh(site, point);
        if weight > 0.0 {
            let told = estimate(record, site, point);
            irradiance += vec4f(told.irradiance * weight, weight);
            noise += vec4f(1.0, site.noise * weight * site.noise * weight, 0.0, 0.0);
            radiance += vec4f(told.radiance * weight, 0.0);
        }
    }
    sums[3u * pixel] = irradiance;
    sums[3u * pixel + 1u] = noise;
    sums[3u * pixel + 2u] = radiance;
}
