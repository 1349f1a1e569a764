// What a record of irradiance says at a point (Ward, Heckbert 1992 eq. 6).

const VALUES: u32 = 15u;
const KIND: u32 = 1u;

struct Estimate {
    irradiance: vec3f,
    radiance: vec3f,
}

fn turns(rotation: f32) -> bool {
    return true;
}

fn pair(at: u32) -> vec2f {
    return vec2f(values[at], values[at + 1u]);
}

fn estimate(record: u32, site: Site, point: Point) -> Estimate {
    let around = frame(site.normal);
    let shift = tangential(around, point.position - site.position) * site.limit;
    let turn = tangential(around, cross(site.normal, point.shading));
    let at = record * VALUES;
    var e = vec3f(values[at], values[at + 1u], values[at + 2u]);
    for (var c = 0u; c < 3u; c++) {
        e[c] += dot(pair(at + 3u + 2u * c), shift) + dot(pair(at + 9u + 2u * c), turn);
    }
    return Estimate(max(e, vec3f(0.0)), vec3f(0.0));
}
