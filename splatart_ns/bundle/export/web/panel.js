"use strict";
// The controls beside the picture.

class Panel {
    /** `owner` has `setPosition(slider, position)`, `reset()`, `setPlaying(bool)`, `setShown(part, bool)`,
        `setPartColours(bool)`, `setAxes(bool)`. */
    constructor(object, owner) {
        this.object = object;
        this.inputs = object.sliders.map((slider, i) => this.addSlider(slider, position => owner.setPosition(i, position)));
        if (!object.sliders.length) get("sliders").append("No part of this object moves.");
        object.parts.forEach((part, i) => {
            const box = element("input", {type: "checkbox", checked: true});
            box.addEventListener("change", () => owner.setShown(i, box.checked));
            get("parts").append(element("label", {className: "part"}, box, swatch(part), breakable(part.name)));
        });
        this.playing = get("play");
        get("reset").addEventListener("click", () => owner.reset());
        this.playing.addEventListener("change", () => owner.setPlaying(this.playing.checked));
        get("part-colours").addEventListener("change", event => owner.setPartColours(event.target.checked));
        get("axes").addEventListener("change", event => owner.setAxes(event.target.checked));
    }

    addSlider(slider, moved) {
        const limits = {min: slider.low, max: slider.high, step: slider.step, value: 0};
        const marks = element("datalist", {id: `marks-${get("sliders").childElementCount}`});
        for (const value of slider.ends) marks.append(element("option", {value}));
        const range = element("input", {type: "range", ...limits}), number = element("input", {type: "number", ...limits});
        range.setAttribute("list", marks.id);
        for (const input of [range, number]) {
            input.setAttribute("aria-label", `${slider.name} (${slider.unit})`);
            input.addEventListener("input", () => Number.isFinite(input.valueAsNumber) && moved(input.valueAsNumber));
        }
        const joint = this.object.joints[slider.joint];
        const head = element("div", {className: "head"},
            swatch(this.object.parts[joint.child]), element("span", {className: "name"}, breakable(slider.name)),
            number, element("span", {className: "unit"}, slider.unit));
        const note = element("div", {className: "note"}, `${joint.type}, ${slider.note}`);
        get("sliders").append(element("div", {className: "slider"}, head, range, marks, note));
        return {range, number};
    }

    /** Show positions of the sliders, in their units; an input that is being typed in is left alone. */
    show(positions) {
        positions.forEach((position, i) => {
            const {range, number} = this.inputs[i];
            const decimals = Math.max(0, Math.round(-Math.log10(this.object.sliders[i].step)));
            range.value = position;
            if (number !== document.activeElement) number.value = position.toFixed(decimals);
        });
    }
}
