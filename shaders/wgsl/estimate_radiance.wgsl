// What a record of radiance says at a point, and what the point's lobe makes of it (Krivanek 2005; Gautron 2004 for the
// rotation). ORDER and STEPS come before this text; the coefficients of an order are rotated one channel at a time.

const N: u32 = ORDER * ORDER;
const VALUES: u32 = 9u * N;
const KIND: u32 = ORDER;
const EVEN: u32 = ORDER * (ORDER + 1u) / 2u;
const ODD: u32 = N - EVEN;
const TURN_MAX: f32 = 0.8;
const CHORD_MAX: f32 = 1.13137085;
const COSINE: vec2f = vec2f(1.2533141, 0.7236012);

struct Estimate {
    irradiance: vec3f,
    radiance: vec3f,
}

// Tables of tilts: for every step the even matrix column by column, then for every step the odd one.
@group(1) @binding(0) var<storage, read> tilts: array<f32>;
@group(1) @binding(1) var<storage, read> index: array<u32>;
@group(1) @binding(2) var<storage, read> lobes: array<f32>;

fn turns(rotation: f32) -> bool {
    return rotation <= TURN_MAX;
}

fn turn(c: ptr<function, array<f32, N>>, angle: vec2f) {
    var multiple = angle;
    for (var m = 1u; m < ORDER; m++) {
        for (var l = m; l < ORDER; l++) {
            let plus = l * l + l + m;
            let minus = l * l + l - m;
            let p = (*c)[plus];
            let q = (*c)[minus];
            (*c)[plus] = p * multiple.x + q * multiple.y;
            (*c)[minus] = q * multiple.x - p * multiple.y;
        }
        multiple = vec2f(angle.x * multiple.x - angle.y * multiple.y, angle.y * multiple.x + angle.x * multiple.y);
    }
}

// Cubic between the four nearest steps.
fn tilt(c: ptr<function, array<f32, N>>, chord: f32) {
    let at = sqrt(min(chord / CHORD_MAX, 1.0)) * f32(STEPS);
    let first = clamp(u32(at), 1u, STEPS - 2u) - 1u;
    let p = at - f32(first);
    let q = p - 1.0;
    let r = p - 2.0;
    let s = p - 3.0;
    let shares = vec4f(q * r * s / -6.0, p * r * s / 2.0, p * q * s / -2.0, p * q * r / 6.0);
    var sums: array<f32, N>;
    for (var j = 0u; j < N; j++) {
        let odd = j >= EVEN;
        let count = select(EVEN, ODD, odd);
        let base = select(0u, EVEN, odd);
        let start = select(0u, (STEPS + 1u) * EVEN * EVEN, odd) + (j - base) * count;
        let value = (*c)[index[j]];
        for (var i = 0u; i < count; i++) {
            let entry = start + i;
            let size = count * count;
            let column = vec4f(
                tilts[entry + first * size],
                tilts[entry + (first + 1u) * size],
                tilts[entry + (first + 2u) * size],
                tilts[entry + (first + 3u) * size],
            );
            sums[base + i] += dot(column, shares) * value;
        }
    }
    for (var j = 0u; j < N; j++) {
        (*c)[index[j]] = sums[j];
    }
}

fn towards(v: vec2f) -> vec2f {
    let length = length(v);
    return select(vec2f(1.0, 0.0), v / length, length > 0.0);
}

fn estimate(record: u32, site: Site, point: Point) -> Estimate {
    let around = frame(site.normal);
    let shift = tangential(around, point.position - site.position) * site.limit;
    let turned = any(point.shading != site.normal);
    let chord = length(point.shading - site.normal);
    let azimuth = towards(tangential(around, point.shading));
    let here = frame(point.shading);
    let along = around.x * azimuth.x + around.y * azimuth.y;
    let tilted = towards(tangential(here, along - point.shading * dot(along, point.shading)));
    let at = record * VALUES;
    var told = Estimate(vec3f(0.0), vec3f(0.0));
    for (var channel = 0u; channel < 3u; channel++) {
        var c: array<f32, N>;
        for (var i = 0u; i < N; i++) {
            let k = at + channel * N + i;
            c[i] = values[k] + shift.x * values[k + 3u * N] + shift.y * values[k + 6u * N];
        }
        if turned {
            turn(&c, azimuth);
            if chord > 0.0 {
                tilt(&c, chord);
            }
            turn(&c, vec2f(tilted.x, -tilted.y));
        }
        var sum = 0.0;
        let lobe = (point.lobe * 3u + channel) * N;
        for (var i = 0u; i < N; i++) {
            sum += lobes[lobe + i] * c[i];
        }
        told.irradiance[channel] = COSINE.x * c[0] + COSINE.y * c[2];
        told.radiance[channel] = sum;
    }
    return told;
}
