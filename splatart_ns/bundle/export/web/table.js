"use strict";
// The table of joints.

const DEGREES = 180 / Math.PI;

function fillTable(object) {
    const rows = object.joints.map(joint => {
        const child = object.parts[joint.child], parent = object.parts[joint.parent];
        return element("tr", {},
            element("th", {scope: "row"}, swatch(child), joint.name),
            element("td", {}, joint.in_tree ? joint.type : `${joint.type}, closes a loop`),
            element("td", {}, parent.name),
            element("td", {}, child.name),
            element("td", {}, hasAxis(joint) ? joint.axis.map(x => withMinus(x.toFixed(3))).join(", ") : "–"),
            element("td", {}, range(joint)),
            element("td", {className: joint.ambiguous ? "warning" : ""}, joint.ambiguous ? doubt(joint, object) : "no"),
            element("td", {}, uncertainty(joint)));
    });
    get("joints").append(...rows);
    get("table").hidden = rows.length === 0;
}

function hasAxis(joint) {
    return ["revolute", "prismatic", "screw", "cylindrical"].includes(joint.type);
}

function doubt(joint, object) {
    return ["yes", ...joint.other_parents.map(part => `may hang on ${object.parts[part].name}`)].join(", ");
}

/** Its range, for each freedom. */
function range(joint) {
    return joint.freedoms.map(({name, unit}, i) => {
        const ends = joint.limits ?? joint.values.map(value => value[i]), values = ends.map(x => x * perUnit(unit));
        return `${name} ${digits(Math.min(...values))} to ${digits(Math.max(...values))} ${unit}`.trim();
    }).join("; ") || "–";
}

/** Standard deviations that the fit gives. */
function uncertainty(joint) {
    const {direction, place, values} = joint.deviations, texts = [];
    if (direction !== null) texts.push(`axis ± ${digits(direction * DEGREES, 2)} degree`);
    if (place !== null) texts.push(`place ± ${digits(place, 2)} ${joint.length_unit}`);
    if (values !== null) {
        const each = joint.freedoms.map(({unit}, i) => `${digits(values[i] * perUnit(unit), 2)} ${unit}`);
        texts.push(`value ± ${each.join(", ")}`);
    }
    return texts.join("; ") || "not determined";
}

function perUnit(unit) {
    return unit === "degree" ? DEGREES : 1;
}
