"use strict";
// Making what a page is made of. Names come from strangers, so texts are only ever set as texts.

function get(id) {
    return document.getElementById(id);
}

/** An element with properties and children; children that are strings become text. */
function element(tag, properties = {}, ...children) {
    const made = Object.assign(document.createElement(tag), properties);
    made.append(...children);
    return made;
}

/** With places to break the line, of which a long name has none that browsers know. */
function breakable(name) {
    return name.replace(/([_.:-])/g, "$1\u200b");
}

/** A square in a part's colour. */
function swatch(part) {
    const made = element("span", {className: "swatch"});
    made.style.background = cssColour(part.colour);
    return made;
}

/** A number for a person, with so many digits that count. */
function digits(x, count = 3) {
    return withMinus(String(Number(x.toPrecision(count))));
}

function withMinus(text) {
    return (Number(text) === 0 ? text.replace("-", "") : text).replace("-", "−");
}
