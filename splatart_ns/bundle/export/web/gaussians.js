"use strict";
// The Gaussians of all parts, unpacked into the textures that the vertex shader reads.

const TEXELS = 4;  // of a Gaussian: centre and part; three axes of its ellipsoid, with opacity and brightness
const TEXTURE_WIDTH = 4096;
const SH_C0 = 0.28209479177387814;  // a colour is 0.5 + SH_C0 times the first coefficient

/** Values of a packed column: whole numbers of 8 or 16 bits, spread evenly between its lows and highs; row by row. */
function unpack(column) {
    const bytes = Uint8Array.from(atob(column.base64), c => c.charCodeAt(0));
    const numbers = column.bits === 16 ? new Uint16Array(bytes.buffer) : bytes;
    const width = column.low.length, steps = 2 ** column.bits - 1;
    return Float32Array.from(numbers, (n, i) => {
        const low = column.low[i % width];
        return low + (column.high[i % width] - low) * n / steps;
    });
}

/** The columns [3] of the rotation of a quaternion wxyz, of any length but 0. */
function quaternionAxes(q) {
    const n = Math.hypot(...q), [w, x, y, z] = q.map(v => v / n);
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
        [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
        [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
    ];
}

class Gaussians {
    constructor(parts) {
        this.count = parts.reduce((sum, part) => sum + part.count, 0);
        /** Coefficients of spherical harmonics, as many for all parts as any has. */
        this.coefficients = Math.max(1, ...parts.map(part => part.coefficients));
        this.centres = new Float32Array(3 * this.count);
        this.parts = new Uint32Array(this.count);
        this.geometry = texels(TEXELS * this.count);
        this.harmonics = texels(this.coefficients * this.count);
        let first = 0;
        parts.forEach((part, index) => {
            this.add(part, index, first);
            first += part.count;
        });
    }

    add(part, index, first) {
        const columns = part.columns;
        const [means, quats, logScales, opacities, sh] =
            [columns.means, columns.quats, columns.log_scales, columns.opacities, columns.sh].map(unpack);
        this.centres.set(means, 3 * first);
        this.parts.fill(index, first, first + part.count);
        for (let i = 0; i < part.count; i++) {
            const to = 4 * TEXELS * (first + i), colour = 3 * part.coefficients * i;
            const axes = quaternionAxes(Array.from(quats.subarray(4 * i, 4 * i + 4)));
            const own = [0, 1, 2].map(c => Math.min(Math.max(0.5 + SH_C0 * sh[colour + c], 0), 1));
            const brightness = (own[0] + own[1] + own[2]) / 3;
            this.geometry.set([...means.subarray(3 * i, 3 * i + 3), index], to);
            axes.forEach((axis, k) => {
                const scale = Math.exp(logScales[3 * i + k]);
                this.geometry.set([...axis.map(x => scale * x), [opacities[i], brightness, 0][k]], to + 4 * (k + 1));
            });
            for (let k = 0; k < part.coefficients; k++) {
                const from = colour + 3 * k;
                this.harmonics.set(sh.subarray(from, from + 3), 4 * (this.coefficients * (first + i) + k));
            }
        }
    }
}

/** Room for so many texels of four numbers, in whole rows of a texture. */
function texels(count) {
    return new Float32Array(4 * TEXTURE_WIDTH * Math.max(1, Math.ceil(count / TEXTURE_WIDTH)));
}
