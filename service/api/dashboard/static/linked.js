// Plots over one x axis: one cursor through all of them, one zoom, marks, and a stretch that is chosen by dragging.

import { h, replace } from "./dom.js";
import { plotly } from "./plots.js";

const LEAST = 4; // px, below which a drag was a click
const FULL = 80; // % of a plot's width, beyond which a mark's word stands before it

/**
 * Plots that belong together. moved(x): the cursor was moved to x; chosen([from, to]): a stretch was dragged, null: a
 * click took it away. zooms: they zoom together; stays: the cursor stays where the pointer left, else moved(null). All numbers are those of the x axis, which is linear and the same in each plot.
 */
export class Linked {
  #plots = new Map();
  #zooms;
  #stays;
  #at = null;
  #stretch = null;
  #marks = [];
  #dragging = false;

  constructor({ moved = () => {}, chosen = () => {}, zooms = false, stays = true } = {}) {
    [this.#zooms, this.#stays] = [zooms, stays];
    Object.assign(this, { moved, chosen });
  }

  /** Take a plot in, once it is drawn. */
  add(element) {
    if (this.#plots.has(element)) return;
    const cursor = h("div", { class: "cursor", hidden: true }), stretch = h("div", { class: "stretch", hidden: true }), marks = h("div", {});
    const layer = h("div", { class: "linked", "aria-hidden": "true" }, stretch, marks, cursor);
    const parts = { layer, cursor, stretch, marks };
    this.#plots.set(element, parts);
    element.classList.add("linking");
    element.append(layer);
    element.addEventListener("pointermove", (event) => this.#follow(element, event));
    if (!this.#stays) element.addEventListener("pointerleave", () => this.#go(null));
    this.#drag(element, layer);
    element.on("plotly_afterplot", () => this.#place(element, parts));
    if (this.#zooms) element.on("plotly_relayout", (change) => this.#zoom(element, change));
    layer.classList.toggle("dragging", this.#dragging);
    this.#place(element, parts);
  }

  /** Put the cursor at x in all plots; null: nowhere. */
  point(x) {
    this.#at = x;
    for (const [element, { cursor }] of this.#plots) stand(cursor, element, x, x);
  }

  /** Shade a stretch [from, to] in all plots; null: none. */
  shade(stretch) {
    this.#stretch = stretch;
    for (const [element, { stretch: shown }] of this.#plots) stand(shown, element, ...(stretch ?? [null, null]));
  }

  /** Mark places in all plots by a line with a word: [{x, word, kind}], kind as of a badge. */
  mark(marks) {
    this.#marks = marks;
    for (const [element, parts] of this.#plots) this.#flag(element, parts);
  }

  /** Whether dragging chooses a stretch, rather than what the plots do by themselves. */
  drag(chooses) {
    this.#dragging = chooses;
    for (const { layer } of this.#plots.values()) layer.classList.toggle("dragging", chooses);
  }

  /** See all of the x axis again, in all plots. */
  async reset() {
    const Plotly = await plotly();
    for (const element of this.#plots.keys()) Plotly.relayout(element, { "xaxis.autorange": true });
  }

  #place(element, { layer, cursor, stretch, marks }) {
    const area = element.querySelector(".nsewdrag")?.getBoundingClientRect();
    if (!area) return;
    const outer = element.getBoundingClientRect();
    const [left, top] = [area.left - outer.left, area.top - outer.top];
    layer.style.cssText = `left: ${left}px; top: ${top}px; width: ${area.width}px; height: ${area.height}px`;
    stand(cursor, element, this.#at, this.#at);
    stand(stretch, element, ...(this.#stretch ?? [null, null]));
    this.#flag(element, { marks });
  }

  #flag(element, { marks }) {
    const made = this.#marks.map(({ x, word, kind }) => {
      const mark = h("div", { class: `mark ${kind}`, "data-word": word });
      stand(mark, element, x, x);
      mark.classList.toggle("late", parseFloat(mark.style.left) > FULL);
      return mark;
    });
    replace(marks, made);
  }

  #follow(element, event) {
    if (event.pointerType === "touch" && !this.#dragging) return; // a finger scrolls
    const x = place(element, this.#plots.get(element).layer, event);
    if (x !== null || !this.#stays) this.#go(x);
  }

  #go(x) {
    if (x === this.#at) return;
    this.point(x);
    this.moved(x);
  }

  #drag(element, layer) {
    let from = null, began = 0;
    const end = (event) => {
      if (from === null) return;
      const to = place(element, layer, event, true);
      const far = Math.abs(event.clientX - began) >= LEAST;
      const stretch = far ? [Math.min(from, to), Math.max(from, to)] : null;
      from = null;
      this.shade(stretch);
      this.chosen(stretch);
    };
    layer.addEventListener("pointerdown", (event) => {
      layer.setPointerCapture(event.pointerId);
      [from, began] = [place(element, layer, event, true), event.clientX];
      event.preventDefault();
    });
    layer.addEventListener("pointermove", (event) => {
      if (from === null) return;
      const to = place(element, layer, event, true);
      this.shade([Math.min(from, to), Math.max(from, to)]);
    });
    layer.addEventListener("pointerup", end);
    layer.addEventListener("pointercancel", () => (from = null));
  }

  async #zoom(element, change) {
    const all = change["xaxis.autorange"] === true;
    if (!all && !("xaxis.range[0]" in change)) return;
    const range = [change["xaxis.range[0]"], change["xaxis.range[1]"]];
    const Plotly = await plotly();
    for (const other of this.#plots.keys()) {
      const now = other.layout.xaxis;
      if (other === element || (all ? now.autorange : now.range[0] === range[0] && now.range[1] === range[1])) continue;
      Plotly.relayout(other, all ? { "xaxis.autorange": true } : { "xaxis.range[0]": range[0], "xaxis.range[1]": range[1] });
    }
  }
}

/** Put what belongs to a layer between two places of the x axis, or on one; away where there is none. */
function stand(part, element, from, to) {
  const [low, high] = element.layout?.xaxis?.range ?? [0, 0];
  const share = (x) => (100 * (x - low)) / (high - low);
  const away = from === null || !(high > low) || to < low || from > high;
  part.hidden = away;
  if (away) return;
  part.style.left = `${Math.max(share(from), 0)}%`;
  if (from !== to) part.style.width = `${Math.min(share(to), 100) - Math.max(share(from), 0)}%`;
}

/** Where on the x axis a pointer is; null beside the axes, unless the nearest place will do. */
function place(element, layer, event, nearest = false) {
  const area = layer.getBoundingClientRect();
  const share = (event.clientX - area.left) / area.width;
  if (!nearest && (!(share >= 0 && share <= 1) || event.clientY < area.top || event.clientY > area.bottom)) return null;
  const [low, high] = element.layout.xaxis.range;
  return low + Math.min(Math.max(share, 0), 1) * (high - low);
}
