// Sums over weights: what each pixel is told. One of summed_*.wgsl says where the sums are.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read_write> answers: array<Answer>;

@compute @workgroup_size(16, 16)
fn normalise(@builtin(global_invocation_id) at: vec3u) {
    if at.x >= view.width || at.y >= view.height {
        return;
    }
    let irradiance = summed(at.xy, 0u);
    let noise = summed(at.xy, 1u);
    let radiance = summed(at.xy, 2u);
    var answer = Answer(vec3f(0.0), 0.0, vec3f(0.0), 0.0);
    if irradiance.w > 0.0 {
        answer = Answer(irradiance.xyz / irradiance.w, sqrt(noise.y) / irradiance.w, radiance.xyz / irradiance.w, noise.x);
    }
    answers[at.y * view.width + at.x] = answer;
}
