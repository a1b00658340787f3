#version 300 es
// A Gaussian of a part as an ellipse on the screen: the local affine projection of EWA splatting, with the formulae and
// limits of splatart_ns/rasterize/projection.py.
precision highp float;
precision highp int;

const int WIDTH_BITS = 12;  // of TEXTURE_WIDTH
const float BLUR = 1.0 / 12.0;  // variance added to the projected covariance, pixel^2: that of a square pixel
const float LEAST_ALPHA = 1.0 / 255.0;
const float MARGIN = 0.15;  // of the image, beyond which the slope in the derivative is kept from growing
const float OWN_COLOUR = 0.7;  // the share of a part's colour that does not depend on brightness

uniform highp sampler2D geometry, harmonics, parts;
uniform int coefficients;
uniform vec2 size, focal, principal;  // pixel
uniform float near;
uniform bool inPartColours;

out vec2 place;  // in standard deviations
flat out vec4 colour;

int gaussian;

vec4 texel(sampler2D from, int n) {
    return texelFetch(from, ivec2(n & ((1 << WIDTH_BITS) - 1), n >> WIDTH_BITS), 0);
}

vec3 coefficient(int k) {
    return texel(harmonics, gaussian * coefficients + k).rgb;
}

// Order and signs as in splatart_ns/geometry/spherical_harmonics.py.
vec3 shColour(vec3 d) {
    vec3 c = 0.5 + 0.28209479177387814 * coefficient(0);
    if (coefficients > 1)
        c += 0.4886025119029199 * (-d.y * coefficient(1) + d.z * coefficient(2) - d.x * coefficient(3));
    if (coefficients > 4) {
        c += 1.0925484305920792 * (d.x * d.y * coefficient(4) - d.y * d.z * coefficient(5) - d.x * d.z * coefficient(7));
        c += 0.31539156525252005 * (2.0 * d.z * d.z - d.x * d.x - d.y * d.y) * coefficient(6);
        c += 0.5462742152960396 * (d.x * d.x - d.y * d.y) * coefficient(8);
    }
    if (coefficients > 9) {
        float x2 = d.x * d.x, y2 = d.y * d.y, z2 = d.z * d.z;
        c -= 0.5900435899266435 * d.y * (3.0 * x2 - y2) * coefficient(9);
        c += 2.890611442640554 * d.x * d.y * d.z * coefficient(10);
        c -= 0.4570457994644658 * d.y * (4.0 * z2 - x2 - y2) * coefficient(11);
        c += 0.3731763325901154 * d.z * (2.0 * z2 - 3.0 * x2 - 3.0 * y2) * coefficient(12);
        c -= 0.4570457994644658 * d.x * (4.0 * z2 - x2 - y2) * coefficient(13);
        c += 1.445305721320277 * d.z * (x2 - y2) * coefficient(14);
        c -= 0.5900435899266435 * d.x * (x2 - 3.0 * y2) * coefficient(15);
    }
    return max(c, 0.0);
}

void main() {
    gaussian = gl_VertexID >> 2;
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  // outside, unless it is seen
    vec4 first = texel(geometry, 4 * gaussian);
    vec3 mean = first.xyz;
    int part = int(first.w);
    // T_camera_part, OpenCV axes, and the camera's place in the part's frame.
    vec4 row0 = texelFetch(parts, ivec2(0, part), 0), row1 = texelFetch(parts, ivec2(1, part), 0),
         row2 = texelFetch(parts, ivec2(2, part), 0), eye = texelFetch(parts, ivec2(3, part), 0),
         partColour = texelFetch(parts, ivec2(4, part), 0);
    vec4 axis0 = texel(geometry, 4 * gaussian + 1), axis1 = texel(geometry, 4 * gaussian + 2),
         axis2 = texel(geometry, 4 * gaussian + 3);
    float opacity = axis0.w, brightness = axis1.w;

    vec3 local = vec3(dot(row0, vec4(mean, 1.0)), dot(row1, vec4(mean, 1.0)), dot(row2, vec4(mean, 1.0)));
    if (local.z < near || opacity < LEAST_ALPHA) return;
    vec2 slope = local.xy / local.z, scale = focal / local.z;
    vec2 limited = clamp(slope, (-MARGIN * size - principal) / focal, ((1.0 + MARGIN) * size - principal) / focal);
    vec2 centre = focal * slope + principal;

    // The image's derivative by the place in the part's frame, times the axes of the ellipsoid.
    vec3 du = scale.x * (row0.xyz - limited.x * row2.xyz), dv = scale.y * (row1.xyz - limited.y * row2.xyz);
    mat3 axes = mat3(axis0.xyz, axis1.xyz, axis2.xyz);
    vec3 p = du * axes, q = dv * axes;
    float a = dot(p, p) + BLUR, b = dot(p, q), c = dot(q, q) + BLUR;
    float middle = 0.5 * (a + c), spread = length(vec2(0.5 * (a - c), b));
    float large = middle + spread;
    float small = max((dot(cross(p, q), cross(p, q)) + BLUR * (a + c - BLUR)) / large, 1e-9);  // determinant / large
    vec2 along = spread < 1e-9 * middle ? vec2(1.0, 0.0) : a > c ? vec2(large - c, b) : vec2(b, large - a);
    along = normalize(along);

    // The ellipse ends where alpha falls below what is drawn.
    float reach = sqrt(2.0 * log(opacity / LEAST_ALPHA));
    vec2 corner = vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2.0 - 1.0;
    place = reach * corner;
    vec2 pixel = centre + place.x * sqrt(large) * along + place.y * sqrt(small) * vec2(-along.y, along.x);
    gl_Position = vec4(2.0 * pixel.x / size.x - 1.0, 1.0 - 2.0 * pixel.y / size.y, 0.0, 1.0);

    colour.a = opacity;
    if (inPartColours) colour.rgb = partColour.rgb * (OWN_COLOUR + (1.0 - OWN_COLOUR) * brightness);
    else colour.rgb = shColour(normalize(mean - eye.xyz));
}
