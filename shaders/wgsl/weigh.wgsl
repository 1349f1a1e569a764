// How much a record counts at a point. The twin is src/twin.rs; both follow cache_core's site and details.

const FRAC_1_SQRT_2: f32 = 0.70710678;
const IN_FRONT_TOLERANCE: f32 = 0.01;
const ERROR_MIN: f32 = 1e-4;

// 0 where it does not count.
fn weigh(site: Site, point: Point) -> f32 {
    let offset = point.position - site.position;
    var translation = length(offset) / site.radius;
    let rotation = length(point.normal - site.normal) * FRAC_1_SQRT_2;
    if translation + rotation >= site.a {
        return 0.0;
    }
    if dot(offset, point.normal + site.normal) * 0.5 < -IN_FRONT_TOLERANCE * site.radius {
        return 0.0;
    }
    let m = site.ellipse;
    if m.x + m.z > 0.0 {
        let t = tangential(frame(site.normal), offset);
        translation = max(translation, sqrt(max(t.x * t.x * m.x + 2.0 * t.x * t.y * m.y + t.y * t.y * m.z, 0.0)));
    }
    let error = translation + rotation;
    if error >= site.a || !turns(rotation) {
        return 0.0;
    }
    return 1.0 / max(error, ERROR_MIN * site.a) - 1.0 / site.a;
}

fn tangential(around: Frame, v: vec3f) -> vec2f {
    return vec2f(dot(v, around.x), dot(v, around.y));
}
