// A slider with a number input beside it.

import { html, useState } from "../../preact.js";

const STEPS = 200;

/** A slider from low to high, and an input that also takes values outside. name: for screen readers; label: what is visible. */
export function Dial({ name, label, unit, low, high, value, onchange }) {
  const [text, setText] = useState("");
  const typed = text.trim() !== "" && Number(text) === value; // keep "1." and "1e" as they are typed
  const type = (event) => {
    setText(event.target.value);
    if (event.target.value !== "" && Number.isFinite(Number(event.target.value))) onchange(Number(event.target.value));
  };
  const slide = (event) => onchange(round(Number(event.target.value), low, high));
  const [bottom, top] = inside(low, high), steps = (top - bottom) / STEPS || "any";
  return html`<div class="dial">
    <span aria-hidden="true">${label}</span>
    <input type="range" min=${bottom} max=${top} step=${steps} value=${value} aria-label=${`${name}, slider`} aria-valuetext=${`${value} ${unit}`} onInput=${slide} />
    <input type="number" step="any" value=${typed ? text : String(value)} aria-label=${name} onInput=${type} />
    <span aria-hidden="true" class="muted">${unit}</span>
  </div>`;
}

/** Return the middle of a range, rounded. */
export function middle(low, high) {
  return round((low + high) / 2, low, high);
}

/** Round a value to a thousandth of the order of its range, so that it fits into the input. */
function round(value, low, high) {
  return Number(value.toFixed(decimals(low, high)));
}

/** Return the ends of a range, rounded inwards. */
function inside(low, high) {
  const factor = 10 ** decimals(low, high), [bottom, top] = [Math.ceil(low * factor) / factor, Math.floor(high * factor) / factor];
  return top > bottom ? [bottom, top] : [low, high];
}

function decimals(low, high) {
  return high > low ? Math.min(Math.max(2 - Math.floor(Math.log10(high - low)), 0), 6) : 3;
}
