"use strict";
// A camera that orbits about a point; z is up.

const NEAR = 0.01;  // of the object's radius

class OrbitCamera {
    /** `view`: centre [3], radius, azimuth and elevation (radian), field_of_view (radian, of the shorter side). */
    constructor(view) {
        this.view = view;
        this.reset();
    }

    reset() {
        this.target = this.view.centre.slice();
        this.azimuth = this.view.azimuth;
        this.elevation = this.view.elevation;
        this.distance = 1.1 * this.view.radius / Math.sin(this.view.field_of_view / 2);
    }

    /** What is drawn on so many pixels: T_camera_world (OpenCV axes), focal lengths, principal point, near plane. */
    at(width, height) {
        const focal = Math.min(width, height) / 2 / Math.tan(this.view.field_of_view / 2);
        const [right, up, back] = this.axes();
        const eye = this.target.map((x, i) => x + this.distance * back[i]);
        const rows = [right, up.map(x => -x), back.map(x => -x)];
        const T = rows.flatMap(row => [...row, -(row[0] * eye[0] + row[1] * eye[1] + row[2] * eye[2])]);
        return {
            T_camera_world: [...T, 0, 0, 0, 1],
            fx: focal, fy: focal, cx: width / 2, cy: height / 2, width, height,
            near: NEAR * this.view.radius,
        };
    }

    axes() {
        const [ca, sa] = [Math.cos(this.azimuth), Math.sin(this.azimuth)];
        const [ce, se] = [Math.cos(this.elevation), Math.sin(this.elevation)];
        return [[-sa, ca, 0], [-se * ca, -se * sa, ce], [ce * ca, ce * sa, se]];
    }

    /** Turn by angles, radian. */
    orbit(right, down) {
        this.azimuth -= right;
        this.elevation = Math.min(Math.max(this.elevation + down, -1.55), 1.55);
    }

    /** Move what is seen by shares of the picture's shorter side. */
    pan(right, down) {
        const [x, y] = this.axes(), size = 2 * this.distance * Math.tan(this.view.field_of_view / 2);
        this.target = this.target.map((t, i) => t - size * right * x[i] + size * down * y[i]);
    }

    zoom(factor) {
        const {radius} = this.view;
        this.distance = Math.min(Math.max(this.distance * factor, 0.05 * radius), 100 * radius);
    }
}

/** Let a mouse (left: orbit; right, middle or with shift: pan; wheel: zoom) and fingers (one: orbit; two: pan and zoom) or
    arrow keys move the camera over an element; `changed` is called after each move. */
function attachCamera(camera, element, changed) {
    const pointers = new Map();
    const side = () => Math.min(element.clientWidth, element.clientHeight) || 1;
    const middle = () => {
        const [a, b] = [...pointers.values()];
        return {x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, spread: Math.hypot(a.x - b.x, a.y - b.y) || 1};
    };

    element.addEventListener("pointerdown", event => {
        element.setPointerCapture(event.pointerId);
        pointers.set(event.pointerId, {x: event.clientX, y: event.clientY});
    });
    element.addEventListener("pointermove", event => {
        const last = pointers.get(event.pointerId);
        if (!last) return;
        const next = {x: event.clientX, y: event.clientY};
        if (pointers.size === 2) {
            const before = middle();
            pointers.set(event.pointerId, next);
            const after = middle();
            camera.pan((after.x - before.x) / side(), (after.y - before.y) / side());
            camera.zoom(before.spread / after.spread);
        } else {
            const right = (next.x - last.x) / side(), down = (next.y - last.y) / side();
            pointers.set(event.pointerId, next);
            if (event.buttons & 6 || event.shiftKey) camera.pan(right, down);
            else camera.orbit(4 * right, 4 * down);
        }
        changed();
    });
    for (const type of ["pointerup", "pointercancel"])
        element.addEventListener(type, event => pointers.delete(event.pointerId));
    element.addEventListener("wheel", event => {
        event.preventDefault();
        const lines = event.deltaMode === WheelEvent.DOM_DELTA_PIXEL ? event.deltaY / 40 : event.deltaY;
        camera.zoom(Math.exp(0.04 * Math.min(Math.max(lines, -10), 10)));
        changed();
    }, {passive: false});
    element.addEventListener("contextmenu", event => event.preventDefault());
    element.addEventListener("dblclick", () => {
        camera.reset();
        changed();
    });
    const keys = {
        ArrowLeft: () => camera.orbit(-0.1, 0), ArrowRight: () => camera.orbit(0.1, 0),
        ArrowUp: () => camera.orbit(0, -0.1), ArrowDown: () => camera.orbit(0, 0.1),
        "+": () => camera.zoom(0.9), "-": () => camera.zoom(1 / 0.9),
    };
    element.addEventListener("keydown", event => {
        if (!Object.hasOwn(keys, event.key)) return;
        event.preventDefault();
        keys[event.key]();
        changed();
    });
}
