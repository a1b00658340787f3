"use strict";
// The order of the Gaussians from far to near, found by counting in a thread of its own, as triangles to be drawn.
// (A quad for each as an instance is what one would write first; without a GPU that takes several times as long.)

/** Runs in the worker: nothing outside it exists there. */
function sortingWorker() {
    const KEYS = 65536;
    let centres, parts, depths, keys;

    /** Vertices of the two triangles of each Gaussian of the shown parts, farthest first; those of Gaussian i are 4 i to
        4 i + 3. `rows` holds, for each part, four numbers that make a depth. */
    function sort(rows, shown) {
        let near = Infinity, far = -Infinity, count = 0;
        for (let i = 0; i < parts.length; i++) {
            if (!shown[parts[i]]) continue;
            const r = 4 * parts[i], c = 3 * i;
            const depth = rows[r] * centres[c] + rows[r + 1] * centres[c + 1] + rows[r + 2] * centres[c + 2] + rows[r + 3];
            depths[i] = depth;
            near = Math.min(near, depth);
            far = Math.max(far, depth);
            count++;
        }
        const scale = far > near ? (KEYS - 1) / (far - near) : 0;
        const places = new Uint32Array(KEYS + 1);
        for (let i = 0; i < parts.length; i++) {
            if (!shown[parts[i]]) continue;
            keys[i] = (far - depths[i]) * scale;
            places[keys[i] + 1]++;
        }
        for (let key = 1; key < KEYS; key++) places[key] += places[key - 1];
        const vertices = new Uint32Array(6 * count);
        for (let i = 0; i < parts.length; i++) {
            if (!shown[parts[i]]) continue;
            const to = 6 * places[keys[i]]++, v = 4 * i;
            vertices[to] = v;
            vertices[to + 1] = vertices[to + 3] = v + 1;
            vertices[to + 2] = vertices[to + 4] = v + 2;
            vertices[to + 5] = v + 3;
        }
        return vertices;
    }

    onmessage = ({data}) => {
        if (data.centres) {
            ({centres, parts} = data);
            depths = new Float32Array(parts.length);
            keys = new Uint16Array(parts.length);
        } else {
            const vertices = sort(data.rows, data.shown);
            postMessage(vertices, [vertices.buffer]);
        }
    };
}

class Sorter {
    constructor(gaussians) {
        const address = URL.createObjectURL(new Blob([`(${sortingWorker})()`], {type: "text/javascript"}));
        this.worker = new Worker(address);
        this.worker.postMessage({centres: gaussians.centres, parts: gaussians.parts});
        this.waiting = [];  // the worker answers in turn
        this.worker.onmessage = ({data}) => this.waiting.shift()(data);
    }

    /** A promise of the vertices to be drawn. */
    sort(rows, shown) {
        this.worker.postMessage({rows, shown});
        return new Promise(resolve => this.waiting.push(resolve));
    }
}
