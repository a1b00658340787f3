"use strict";
// The page: what the controls say is what the picture shows.

const MAX_PIXEL_RATIO = 2;
const REST_MILLISECONDS = 200;

class Page {
    constructor(object) {
        this.object = object;
        this.values = object.joints.map(joint => joint.values[0].map(() => 0));
        this.shown = object.parts.map(() => true);
        this.inPartColours = false;
        this.withAxes = true;
        this.sweep = null;
        this.isDue = this.isDrawing = this.isWarm = false;
        this.pace = new Pace();
        this.canvas = get("picture");
        this.camera = new OrbitCamera(object.view);
        this.panel = new Panel(object, this);
        fillTable(object);

        const gaussians = new Gaussians(object.parts);
        const shaders = {vertex: get("splat-vertex").textContent, fragment: get("splat-fragment").textContent};
        this.renderer = new Renderer(this.canvas, gaussians, object.parts.map(part => part.colour), shaders);
        this.sorter = new Sorter(gaussians);
        attachCamera(this.camera, get("scene"), () => this.changed());
        this.canvas.addEventListener("webglcontextlost", () => complain("The picture was lost; load the page again."));
        new ResizeObserver(() => this.changed()).observe(get("scene"));
    }

    /** Ask for a picture; one shows all that has changed until it is drawn, and one at rest follows when nothing does. */
    async changed() {
        this.isDue = true;
        if (this.isDrawing || !this.renderer) return;
        this.isDrawing = true;
        clearTimeout(this.rest);
        while (this.isDue) {
            await new Promise(requestAnimationFrame);
            this.isDue = false;
            if (this.sweep) this.advance();
            const scale = this.pace.scale, started = performance.now();
            await this.drawScene(scale);
            await this.renderer.finished();
            if (this.isWarm) this.pace.learn(scale, (performance.now() - started) / 1000);
            this.isWarm = true;  // the first picture takes longer
        }
        this.isDrawing = false;
        if (this.pace.scale < 1) this.rest = setTimeout(() => this.drawScene(1), REST_MILLISECONDS);
    }

    /** Draw on as many pixels as the screen has, times `scale`; axes always on all. */
    async drawScene(scale) {
        const scene = get("scene"), ratio = Math.min(window.devicePixelRatio, MAX_PIXEL_RATIO);
        const camera = by => this.camera.at(
            Math.max(1, Math.round(by * scene.clientWidth)), Math.max(1, Math.round(by * scene.clientHeight)));
        const motions = await this.draw(camera(scale * ratio));
        get("overlay").hidden = !this.withAxes;
        if (this.withAxes) drawAxes(get("overlay"), this.object, motions, camera(ratio), ratio);
    }

    /** Draw what a camera sees (see `OrbitCamera.at`); returns where the parts are. */
    async draw(camera) {
        const motions = partMotions(this.object, this.values);
        const T_camera_part = motions.map(T => multiply(camera.T_camera_world, T));
        const rows = Float32Array.from(T_camera_part.flatMap(T => T.slice(8, 12)));
        const vertices = await this.sorter.sort(rows, this.shown);
        this.renderer.draw(vertices, T_camera_part, camera, this.inPartColours);
        return motions;
    }

    advance() {
        const now = performance.now();
        this.sweepStart ??= now;
        this.values = this.sweep.at((now - this.sweepStart) / 1000);
        this.showValues();
        this.isDue = true;
    }

    /** Show the joints' values on the sliders. */
    showValues() {
        this.panel.show(this.object.sliders.map(slider => this.values[slider.joint][slider.freedom] * slider.units));
    }

    // What the panel asks for.

    setPosition(index, position) {
        this.setPlaying(false);
        const slider = this.object.sliders[index];
        this.values[slider.joint][slider.freedom] = position / slider.units;
        this.showValues();
        this.changed();
    }

    reset() {
        this.setPlaying(false);
        this.values.forEach(value => value.fill(0));
        this.showValues();
        this.changed();
    }

    setPlaying(isPlaying) {
        this.panel.playing.checked = isPlaying;
        this.sweep = isPlaying ? new Sweep(this.object, this.values) : null;
        this.sweepStart = null;
        if (isPlaying) this.changed();
    }

    setShown(part, isShown) {
        this.shown[part] = isShown;
        this.changed();
    }

    setPartColours(isOn) {
        this.inPartColours = isOn;
        this.changed();
    }

    setAxes(isOn) {
        this.withAxes = isOn;
        this.changed();
    }
}

function complain(text) {
    get("complaint").textContent = text;
    get("complaint").hidden = false;
}

/** For scripts and tests. */
const splatart = {object: JSON.parse(get("object").textContent), page: null};
try {
    splatart.page = new Page(splatart.object);
} catch (error) {
    complain(error.message);
}
