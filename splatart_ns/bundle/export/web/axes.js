"use strict";
// The joints' axes on a canvas over the picture: arrows in their positive direction, in the colour of the part that moves,
// within a band of two standard deviations of where they lie.

const BAND = 2;  // standard deviations

/** Draw the joints of the tree; `motions` are those of the parts, `pixelRatio` the canvas's pixels per CSS pixel. */
function drawAxes(canvas, object, motions, camera, pixelRatio) {
    const context = canvas.getContext("2d");
    if (canvas.width !== camera.width) canvas.width = camera.width;
    if (canvas.height !== camera.height) canvas.height = camera.height;
    context.clearRect(0, 0, canvas.width, canvas.height);
    for (const joint of object.joints) {
        if (!joint.in_tree || !joint.line) continue;
        const T = multiply(camera.T_camera_world, motions[joint.parent]);
        const places = joint.line.points.map((point, i) => {
            const [x, y, z] = transform(T, point);
            const deviation = Math.min(BAND * joint.line.deviations[i] * camera.fx / z, 1e4);
            return {x: camera.fx * x / z + camera.cx, y: camera.fy * y / z + camera.cy, z, deviation};
        });
        if (places.some(place => place.z < camera.near)) continue;
        const colour = cssColour(object.parts[joint.child].colour);
        if (places.length === 1) drawBall(context, places[0], colour, pixelRatio);
        else drawArrow(context, places, colour, pixelRatio);
    }
}

function drawBall(context, {x, y, deviation}, colour, pixelRatio) {
    context.globalAlpha = 0.6;
    context.fillStyle = colour;
    context.beginPath();
    context.arc(x, y, 5 * pixelRatio + deviation, 0, 2 * Math.PI);
    context.fill();
}

function drawArrow(context, places, colour, pixelRatio) {
    const first = places[0], last = places[places.length - 1];
    const length = Math.hypot(last.x - first.x, last.y - first.y);
    const along = length > 0 ? [(last.x - first.x) / length, (last.y - first.y) / length] : [1, 0];
    const aside = (place, by) => [place.x - by * along[1], place.y + by * along[0]];
    context.fillStyle = context.strokeStyle = colour;

    context.globalAlpha = 0.3;
    context.beginPath();
    for (const place of places) context.lineTo(...aside(place, place.deviation));
    for (const place of places.slice().reverse()) context.lineTo(...aside(place, -place.deviation));
    context.fill();

    context.globalAlpha = 0.9;
    context.lineWidth = 2 * pixelRatio;
    context.beginPath();
    context.moveTo(first.x, first.y);
    context.lineTo(last.x, last.y);
    context.stroke();

    const tip = Math.min(12 * pixelRatio, length);  // short where the axis points at the eye
    context.beginPath();
    context.moveTo(last.x + tip * along[0], last.y + tip * along[1]);
    context.lineTo(...aside(last, tip / 2.5));
    context.lineTo(...aside(last, -tip / 2.5));
    context.fill();
}

function cssColour(rgb) {
    return `rgb(${rgb.map(x => Math.round(255 * x)).join(" ")})`;
}
