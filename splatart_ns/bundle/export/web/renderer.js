"use strict";
// Gaussians on a canvas, by WebGL 2: a quad for each, blended from far to near.

const PART_TEXELS = 5;  // three rows of T_camera_part, the camera's place, the colour

class Renderer {
    /** `colours` [3] are those of the parts, in 0..1. Throws an Error where there is no WebGL 2. */
    constructor(canvas, gaussians, colours, shaders) {
        this.canvas = canvas;
        this.gl = canvas.getContext("webgl2", {antialias: false, depth: false, premultipliedAlpha: true});
        if (!this.gl) throw new Error("This browser has no WebGL 2, or it is switched off.");
        const gl = this.gl;
        this.colours = colours;
        this.program = this.link(shaders);
        gl.useProgram(this.program);
        this.uniforms = {};
        for (const name of ["coefficients", "size", "focal", "principal", "near", "inPartColours"])
            this.uniforms[name] = gl.getUniformLocation(this.program, name);
        gl.uniform1i(this.uniforms.coefficients, gaussians.coefficients);
        this.addTexture("geometry", 0, TEXTURE_WIDTH, gaussians.geometry);
        this.addTexture("harmonics", 1, TEXTURE_WIDTH, gaussians.harmonics);
        this.partData = new Float32Array(4 * PART_TEXELS * colours.length);
        this.addTexture("parts", 2, PART_TEXELS, this.partData);

        gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
        gl.enable(gl.BLEND);
        gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    }

    /** Draw the triangles of a `Sorter`, at T_camera_part of each part, seen by a camera (see `OrbitCamera.at`). */
    draw(vertices, T_camera_part, camera, inPartColours) {
        const gl = this.gl, {width, height} = camera;
        T_camera_part.forEach((T, i) => {
            const eye = [0, 1, 2].map(k => -(T[k] * T[3] + T[4 + k] * T[7] + T[8 + k] * T[11]));
            this.partData.set([...T.slice(0, 12), ...eye, 1, ...this.colours[i], 1], 4 * PART_TEXELS * i);
        });
        gl.activeTexture(gl.TEXTURE2);
        gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, PART_TEXELS, this.colours.length, gl.RGBA, gl.FLOAT, this.partData);
        gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, vertices, gl.STREAM_DRAW);
        if (this.canvas.width !== width) this.canvas.width = width;
        if (this.canvas.height !== height) this.canvas.height = height;
        gl.viewport(0, 0, width, height);
        gl.uniform2f(this.uniforms.size, width, height);
        gl.uniform2f(this.uniforms.focal, camera.fx, camera.fy);
        gl.uniform2f(this.uniforms.principal, camera.cx, camera.cy);
        gl.uniform1f(this.uniforms.near, camera.near);
        gl.uniform1i(this.uniforms.inPartColours, inPartColours ? 1 : 0);
        gl.clearColor(0, 0, 0, 0);
        gl.clear(gl.COLOR_BUFFER_BIT);
        gl.drawElements(gl.TRIANGLES, vertices.length, gl.UNSIGNED_INT, 0);
    }

    /** A promise that what was drawn is done. */
    async finished() {
        const gl = this.gl, sync = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
        gl.flush();
        while (!gl.isContextLost() && gl.getSyncParameter(sync, gl.SYNC_STATUS) === gl.UNSIGNALED)
            await new Promise(resolve => setTimeout(resolve, 1));
        gl.deleteSync(sync);
    }

    /** The picture that was just drawn, over black: RGBA bytes from the bottom row up. */
    pixels() {
        const gl = this.gl, {width, height} = this.canvas;
        const bytes = new Uint8Array(4 * width * height);
        gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
        return bytes;
    }

    addTexture(name, unit, width, data) {
        const gl = this.gl, height = data.length / 4 / width;
        gl.activeTexture(gl.TEXTURE0 + unit);
        gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
        gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, width, height, 0, gl.RGBA, gl.FLOAT, data);
        gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
        gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
        gl.uniform1i(gl.getUniformLocation(this.program, name), unit);
    }

    link({vertex, fragment}) {
        const gl = this.gl, program = gl.createProgram();
        for (const [type, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
            const shader = gl.createShader(type);
            gl.shaderSource(shader, source.trim());
            gl.compileShader(shader);
            gl.attachShader(program, shader);
            if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
        }
        gl.linkProgram(program);
        if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
        return program;
    }
}
