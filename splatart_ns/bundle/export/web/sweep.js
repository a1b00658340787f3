"use strict";
// The sweep: one joint after the other over its range, there and back, as in splatart_ns/bundle/configurations.py.

const SWEEP_SECONDS = 4;  // of a joint

class Sweep {
    /** Starts at the joints' `values`, which are left as they are. */
    constructor(object, values) {
        this.object = object;
        this.start = values.map(value => value.slice());
        this.moving = object.joints.flatMap((joint, i) => joint.in_tree && hasMoved(joint) ? [i] : []);
    }

    /** The values of the joints after so many seconds; it begins again after the last joint. */
    at(seconds) {
        const values = this.start.map(value => value.slice());
        if (this.moving.length) {
            const joint = this.moving[Math.floor(seconds / SWEEP_SECONDS) % this.moving.length];
            values[joint] = sweptValue(this.object.joints[joint], values[joint], (seconds / SWEEP_SECONDS) % 1);
        }
        return values;
    }
}

function hasMoved({freedoms, limits, values}) {
    if (freedoms.length > 1) return values.flat().some(x => x !== 0);
    return freedoms.length === 1 && limits !== null && limits[0] < limits[1];
}

/** A joint's value after a `share` of its way. One of one freedom moves over its range like a cosine, from `start`; one
    of several goes through its values at the states in turn, and back. */
function sweptValue(joint, start, share) {
    if (start.length > 1) {
        const at = (joint.values.length - 1) * (1 - Math.cos(2 * Math.PI * share)) / 2;
        const before = Math.min(Math.floor(at), joint.values.length - 2), part = at - before;
        return joint.values[before].map((x, i) => x + part * (joint.values[before + 1][i] - x));
    }
    const [low, high] = joint.limits;
    const from = Math.min(Math.max(start[0], low), high);
    const angle = Math.acos(1 - 2 * (from - low) / (high - low)) + 2 * Math.PI * share;
    return [low + (high - low) * (1 - Math.cos(angle)) / 2];
}
