// Plots that share a linear x axis: their cursor, zoom, marks, and a range selected by dragging.

import { plotly } from "./plots.js";

const MIN_DRAG_PX = 4; // a shorter drag is a click
const LATE_MARK_PERCENT = 80; // of the plot's width; the label of a later mark is drawn on its left

/**
 * Plots with a common cursor. All numbers are values of the x axis.
 * moved(x): called when the pointer moves the cursor; null if it left and `stays` is false.
 * chosen([from, to]): called when a range was dragged; null if a click removed it.
 * zooms: zoom all plots together. stays: keep the cursor if the pointer leaves.
 */
export class LinkedPlots {
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

  /** Add a plot that has been drawn. */
  add(element) {
    if (this.#plots.has(element)) return;
    const cursor = box("cursor"), stretch = box("stretch"), marks = box(""), layer = box("linked");
    cursor.hidden = stretch.hidden = true;
    layer.setAttribute("aria-hidden", "true");
    layer.append(stretch, marks, cursor);
    const parts = { layer, cursor, stretch, marks };
    this.#plots.set(element, parts);
    element.classList.add("linking");
    element.append(layer);
    element.addEventListener("pointermove", (event) => this.#follow(element, event));
    if (!this.#stays) element.addEventListener("pointerleave", () => this.#moveCursor(null));
    this.#drag(element, layer);
    element.on("plotly_afterplot", () => this.#layOut(element, parts));
    if (this.#zooms) element.on("plotly_relayout", (change) => this.#zoom(element, change));
    layer.classList.toggle("dragging", this.#dragging);
    this.#layOut(element, parts);
  }

  /** Show the cursor at x in all plots; null hides it. */
  point(x) {
    this.#at = x;
    for (const [element, { cursor }] of this.#plots) placeBetween(cursor, element, x, x);
  }

  /** Shade a range [from, to] in all plots; null removes it. */
  shade(stretch) {
    this.#stretch = stretch;
    for (const [element, { stretch: shown }] of this.#plots) placeBetween(shown, element, ...(stretch ?? [null, null]));
  }

  /** Draw labelled lines in all plots: [{x, word, kind}]; kind as in `badge`. */
  mark(marks) {
    this.#marks = marks;
    for (const [element, parts] of this.#plots) this.#drawMarks(element, parts);
  }

  /** Set whether dragging selects a range instead of zooming. */
  drag(chooses) {
    this.#dragging = chooses;
    for (const { layer } of this.#plots.values()) layer.classList.toggle("dragging", chooses);
  }

  /** Show the whole x axis in all plots. */
  async reset() {
    const Plotly = await plotly();
    for (const element of this.#plots.keys()) Plotly.relayout(element, { "xaxis.autorange": true });
  }

  #layOut(element, { layer, cursor, stretch, marks }) {
    const areas = [...element.querySelectorAll(".nsewdrag")].map((each) => each.getBoundingClientRect()); // one for each y axis
    if (!areas.length) return;
    const outer = element.getBoundingClientRect();
    const [top, bottom] = [Math.min(...areas.map((each) => each.top)), Math.max(...areas.map((each) => each.bottom))];
    layer.style.cssText = `left: ${areas[0].left - outer.left}px; top: ${top - outer.top}px; width: ${areas[0].width}px; height: ${bottom - top}px`;
    placeBetween(cursor, element, this.#at, this.#at);
    placeBetween(stretch, element, ...(this.#stretch ?? [null, null]));
    this.#drawMarks(element, { marks });
  }

  #drawMarks(element, { marks }) {
    const made = this.#marks.map(({ x, word, kind }) => {
      const mark = box(`mark ${kind}`);
      mark.dataset.word = word;
      placeBetween(mark, element, x, x);
      mark.classList.toggle("late", parseFloat(mark.style.left) > LATE_MARK_PERCENT);
      return mark;
    });
    marks.replaceChildren(...made);
  }

  #follow(element, event) {
    if (event.pointerType === "touch" && !this.#dragging) return; // a finger scrolls
    const x = xUnderPointer(element, this.#plots.get(element).layer, event);
    if (x !== null || !this.#stays) this.#moveCursor(x);
  }

  #moveCursor(x) {
    if (x === this.#at) return;
    this.point(x);
    this.moved(x);
  }

  #drag(element, layer) {
    let from = null, began = 0;
    const end = (event) => {
      if (from === null) return;
      const to = xUnderPointer(element, layer, event, true);
      const far = Math.abs(event.clientX - began) >= MIN_DRAG_PX;
      const stretch = far ? [Math.min(from, to), Math.max(from, to)] : null;
      from = null;
      this.shade(stretch);
      this.chosen(stretch);
    };
    layer.addEventListener("pointerdown", (event) => {
      layer.setPointerCapture(event.pointerId);
      [from, began] = [xUnderPointer(element, layer, event, true), event.clientX];
      event.preventDefault();
    });
    layer.addEventListener("pointermove", (event) => {
      if (from === null) return;
      const to = xUnderPointer(element, layer, event, true);
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

/** Place an element of a layer between two x values, or at one; hide it if there is none. */
function placeBetween(part, element, from, to) {
  const [low, high] = element.layout?.xaxis?.range ?? [0, 0];
  const share = (x) => (100 * (x - low)) / (high - low);
  const away = from === null || !(high > low) || to < low || from > high;
  part.hidden = away;
  if (away) return;
  part.style.left = `${Math.max(share(from), 0)}%`;
  if (from !== to) part.style.width = `${Math.min(share(to), 100) - Math.max(share(from), 0)}%`;
}

/** Return the x value under a pointer; outside the axes null, or the nearest value if `nearest`. */
function xUnderPointer(element, layer, event, nearest = false) {
  const area = layer.getBoundingClientRect();
  const share = (event.clientX - area.left) / area.width;
  if (!nearest && (!(share >= 0 && share <= 1) || event.clientY < area.top || event.clientY > area.bottom)) return null;
  const [low, high] = element.layout.xaxis.range;
  return low + Math.min(Math.max(share, 0), 1) * (high - low);
}

function box(kind) {
  const made = document.createElement("div");
  made.className = kind;
  return made;
}
