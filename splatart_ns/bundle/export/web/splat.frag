#version 300 es
// What a Gaussian adds to a pixel, multiplied by its alpha.
precision highp float;

in vec2 place;
flat in vec4 colour;
out vec4 result;

void main() {
    float alpha = min(colour.a * exp(-0.5 * dot(place, place)), 0.999);
    if (alpha < 1.0 / 255.0) discard;
    result = vec4(alpha * colour.rgb, alpha);
}
