"use strict";
// Rigid motions, as 16 numbers row by row, and forward kinematics: the formulae of splatart_ns/geometry/se3.py,
// stages/joint_parameters.py and bundle/posing.py.

const IDENTITY = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];

function multiply(a, b) {
    const product = new Array(16);
    for (let i = 0; i < 4; i++) {
        for (let j = 0; j < 4; j++) {
            let sum = 0;
            for (let k = 0; k < 4; k++) sum += a[4 * i + k] * b[4 * k + j];
            product[4 * i + j] = sum;
        }
    }
    return product;
}

/** The image of a point [3] under a motion. */
function transform(T, [x, y, z]) {
    return [0, 4, 8].map(i => T[i] * x + T[i + 1] * y + T[i + 2] * z + T[i + 3]);
}

/** The image of a direction [3]. */
function rotate(T, [x, y, z]) {
    return [0, 4, 8].map(i => T[i] * x + T[i + 1] * y + T[i + 2] * z);
}

function withTranslation(T, t) {
    const moved = T.slice();
    for (let i = 0; i < 3; i++) moved[4 * i + 3] = t[i];
    return moved;
}

/** The motion 1 + first [phi] + second [phi]^2, where [phi] is the matrix of the cross product by phi. */
function crossSeries([x, y, z], first, second) {
    return [
        1 - second * (y * y + z * z), second * x * y - first * z, second * x * z + first * y, 0,
        second * x * y + first * z, 1 - second * (x * x + z * z), second * y * z - first * x, 0,
        second * x * z - first * y, second * y * z + first * x, 1 - second * (x * x + y * y), 0,
        0, 0, 0, 1,
    ];
}

/** sin(t) / t, (1 - cos(t)) / t^2 and (t - sin(t)) / t^3, also near 0. */
function angleSeries(phi) {
    const t2 = phi[0] ** 2 + phi[1] ** 2 + phi[2] ** 2, t = Math.sqrt(t2);
    if (t < 1e-3) return [1 - t2 / 6, 0.5 - t2 / 24, 1 / 6 - t2 / 120];
    return [Math.sin(t) / t, 2 * Math.sin(t / 2) ** 2 / t2, (t - Math.sin(t)) / (t2 * t)];
}

/** The rotation by a rotation vector (Rodrigues). */
function so3Exp(phi) {
    const [a, b] = angleSeries(phi);
    return crossSeries(phi, a, b);
}

/** The motion of a tangent (translation, rotation) [6]. */
function se3Exp(xi) {
    const phi = xi.slice(3), [a, b, c] = angleSeries(phi);
    return withTranslation(crossSeries(phi, a, b), rotate(crossSeries(phi, b, c), xi.slice(0, 3)));
}

/** A rotation about a point [3]. */
function about(R, point) {
    const turned = rotate(R, point);
    return withTranslation(R, point.map((x, i) => x - turned[i]));
}

/** The child's motion relative to its parent at a value: an array of as many numbers as the joint has freedoms. */
function jointMotion(joint, value) {
    if (joint.type === "fixed") return IDENTITY;
    if (joint.type === "free") return se3Exp(value);
    if (joint.type === "spherical") return about(so3Exp(value), joint.origin);
    let turn = 0, slide = 0;
    if (joint.type === "revolute") turn = value[0];
    else if (joint.type === "prismatic") slide = value[0];
    else if (joint.type === "screw") [turn, slide] = [value[0], joint.pitch * value[0]];
    else if (joint.type === "cylindrical") [slide, turn] = value;
    else throw new Error(`a joint of unknown type ${joint.type}`);
    const T = about(so3Exp(joint.axis.map(x => turn * x)), joint.origin);
    return withTranslation(T, [0, 1, 2].map(i => T[4 * i + 3] + slide * joint.axis[i]));
}

/** Where each part is: motions from the canonical frame, at values of the joints (an array for each, in their order). */
function partMotions(object, values) {
    const motions = object.parts.map(() => IDENTITY);
    object.joints.forEach((joint, i) => {  // parents come before children
        if (joint.in_tree) motions[joint.child] = multiply(motions[joint.parent], jointMotion(joint, values[i]));
    });
    return motions;
}
