"use strict";
// How many pixels a picture has while something moves: as many as are drawn in time, all where there is a graphics card.

const FRAME_SECONDS = 0.05;
const LEAST_SCALE = 0.4;

const STEPS = 10;  // few different sizes: a canvas of a new size is a new one

class Pace {
    constructor() {
        this.fitting = 1;
    }

    /** Of the sides of a picture in motion, to those of one at rest. */
    get scale() {
        return Math.ceil(STEPS * this.fitting) / STEPS;
    }

    /** Take into account how long a picture at `scale` took: roughly, as long as it has pixels. */
    learn(scale, seconds) {
        const fitting = scale * Math.sqrt(FRAME_SECONDS / Math.max(seconds, 1e-3));
        this.fitting = Math.min(Math.max((this.fitting + fitting) / 2, LEAST_SCALE), 1);
    }
}
