// Which pixels a record may reach: a rectangle round the projection of its sphere and, where it has one, of its ellipse.
// The twin is src/reach.rs.

// Pixels a rectangle is wider than the projection, for points that lie a rounding away from their ray.
const SLACK: f32 = 0.125;

// Slopes between which a circle at `at` (across, ahead) lies as seen from the origin: (low, high), low > high for none.
fn slopes(at: vec2f, radius: f32) -> vec2f {
    let far = 1e30;
    let square = dot(at, at);
    if square <= radius * radius {
        return vec2f(-far, far);
    }
    // Directions of both tangents.
    let s = radius / sqrt(square);
    let c = sqrt(1.0 - s * s);
    let low = vec2f(at.x * c - at.y * s, at.y * c + at.x * s);
    let high = vec2f(at.x * c + at.y * s, at.y * c - at.x * s);
    // Both behind the eye.
    if (low.y <= 0.0 && at.x > 0.0) || (high.y <= 0.0 && at.x <= 0.0) {
        return vec2f(far, -far);
    }
    return vec2f(select(-far, low.x / low.y, low.y > 0.0), select(far, high.x / high.y, high.y > 0.0));
}

// (left, top, right, bottom) in pixels, clipped to the region; empty where right <= left or bottom <= top.
fn reach(view: View, site: Site) -> vec4f {
    let away = site.position - view.eye;
    let at = vec3f(dot(away, view.right), dot(away, view.down), dot(away, view.forward));
    let radius = site.a * site.radius;
    var low: vec2f;
    var high: vec2f;
    if view.parallel == 1u {
        if at.z + radius < 0.0 {
            return vec4f(0.0);
        }
        low = (at.xy - radius) * view.scale + view.centre;
        high = (at.xy + radius) * view.scale + view.centre;
    } else {
        let x = slopes(at.xz, radius);
        let y = slopes(at.yz, radius);
        if x.x > x.y || y.x > y.y {
            return vec4f(0.0);
        }
        low = vec2f(x.x, y.x) * view.scale + view.centre;
        high = vec2f(x.y, y.y) * view.scale + view.centre;
    }
    let m = site.ellipse;
    if m.x + m.z > 0.0 {
        // A box round the sphere along the axes of the ellipse, cut where the ellipse ends.
        let around = frame(site.normal);
        let half = 0.5 * (m.x - m.z);
        let root = sqrt(half * half + m.y * m.y);
        let mean = 0.5 * (m.x + m.z);
        var axis = select(vec2f(m.y, root - half), vec2f(root + half, m.y), half >= 0.0);
        let length = length(axis);
        axis = select(vec2f(1.0, 0.0), axis / length, length > 0.0);
        let u = (around.x * axis.x + around.y * axis.y) * min(radius, site.a / sqrt(mean + root));
        let least = max(mean - root, 0.0);
        let v = (around.y * axis.x - around.x * axis.y) * select(radius, min(radius, site.a / sqrt(least)), least > 0.0);
        let n = site.normal * radius;
        var box_low = vec2f(1e30);
        var box_high = vec2f(-1e30);
        var ahead = true;
        for (var i = 0u; i < 8u; i++) {
            let corner = away + select(u, -u, (i & 1u) == 1u) + select(v, -v, (i & 2u) == 2u) + select(n, -n, (i & 4u) == 4u);
            let local = vec2f(dot(corner, view.right), dot(corner, view.down));
            let z = select(dot(corner, view.forward), 1.0, view.parallel == 1u);
            // Behind the eye a corner projects to nowhere: the sphere's rectangle has to do.
            ahead = ahead && z > 1e-3 * radius;
            let pixel = local / z * view.scale + view.centre;
            box_low = min(box_low, pixel);
            box_high = max(box_high, pixel);
        }
        if ahead {
            low = max(low, box_low);
            high = min(high, box_high);
        }
    }
    let size = vec2f(f32(view.width), f32(view.height));
    low = clamp(floor(low - SLACK), vec2f(0.0), size);
    high = clamp(ceil(high + SLACK), vec2f(0.0), size);
    if high.x <= low.x || high.y <= low.y {
        return vec4f(0.0);
    }
    return vec4f(low, high);
}
