// The sums that splat.wgsl blended.
@group(0) @binding(2) var irradiance_sums: texture_2d<f32>;
@group(0) @binding(3) var noise_sums: texture_2d<f32>;
@group(0) @binding(4) var radiance_sums: texture_2d<f32>;

fn summed(at: vec2u, which: u32) -> vec4f {
    switch which {
        case 0u: { return textureLoad(irradiance_sums, at, 0); }
        case 1u: { return textureLoad(noise_sums, at, 0); }
        default: { return textureLoad(radiance_sums, at, 0); }
    }
}
