// Draws records onto the pixels they reach (Gautron 2005): one quad each, blended by addition, in the order of their ids.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> sites: array<Site>;
@group(0) @binding(2) var<storage, read> values: array<f32>;
@group(0) @binding(3) var<storage, read> points: array<Point>;

struct Quad {
    @builtin(position) position: vec4f,
    @location(0) @interpolate(flat) record: u32,
}

struct Sums {
    // Weighted irradiance, and the weights.
    @location(0) irradiance: vec4f,
    // How many records, and their squared noise.
    @location(1) noise: vec4f,
    // Weighted radiance.
    @location(2) radiance: vec4f,
}

@vertex
fn quad(@builtin(vertex_index) corner: u32, @builtin(instance_index) instance: u32) -> Quad {
    let bounds = reach(view, sites[instance]);
    let x = select(bounds.x, bounds.z, (corner & 1u) == 1u);
    let y = select(bounds.y, bounds.w, (corner & 2u) == 2u);
    let size = vec2f(f32(view.width), f32(view.height));
    return Quad(vec4f(vec2f(x, y) / size * vec2f(2.0, -2.0) + vec2f(-1.0, 1.0), 0.0, 1.0), instance);
}

@fragment
fn splat(quad: Quad) -> Sums {
    let pixel = vec2u(quad.position.xy);
    let point = points[pixel.y * view.width + pixel.x];
    if point.kind != KIND {
        discard;
    }
    let site = sites[quad.record];
    let weight = weigh(site, point);
    if weight <= 0.0 {
        discard;
    }
    let told = estimate(quad.record, site, point);
    let noise = site.noise * weight;
    return Sums(
        vec4f(told.irradiance * weight, weight),
        vec4f(1.0, noise * noise, 0.0, 0.0),
        vec4f(told.radiance * weight, 0.0),
    );
}
