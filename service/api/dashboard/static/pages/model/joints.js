// Small plots of a trace, one for each joint, with a common zoom. If rows are skipped, zooming loads them.

import { jointVar } from "../../colours.js";
import { h, replace } from "../../dom.js";
import { count, shortNames, torqueUnit } from "../../format.js";
import { LinkedPlots } from "../../linked.js";
import { plot, plotly } from "../../plots.js";
import { button, errorBox, field, select } from "../../ui.js";
import { axis } from "./curves.js";

const ALL = "all joints";

/**
 * Draw a trace into an element, one plot for each joint.
 * first: trace of all rows; fetch(start, stop): read the trace of some rows, (0, null) for all;
 * views: {label: (trace, joint, x) => traces}, of which one is shown; about: {label: explanation}.
 */
export async function jointPlots(element, { first, fetch, views, about, signal }) {
  const names = shortNames(first.joint_names);
  const labels = Object.keys(views);
  const shown = { trace: first, joint: ALL, view: labels[0] };
  const plots = new Map();
  let requests = 0, isDrawing = false;
  const places = first.joint_names.map(() => h("div", {}));
  const linked = new LinkedPlots({ stays: false });
  const grid = h("div", { class: "grid" }, places), rowsNote = h("span", {}), note = h("span", {}), key = h("p", { class: "actions" });
  const problem = h("div", {});
  const start = h("input", { type: "number", min: "0", step: "1" }), stop = h("input", { type: "number", min: "1", step: "1" });

  const draw = async () => {
    const { trace } = shown;
    const { x, suffix } = axis(trace);
    isDrawing = true;
    for (const [joint, place] of places.entries()) {
      place.hidden = shown.joint !== ALL && shown.joint !== first.joint_names[joint];
      if (place.hidden) continue;
      const layout = {
        title: names[joint],
        y: torqueUnit(trace.joint_types?.[joint]),
        height: shown.joint === ALL ? 210 : 420,
        margin: { l: 52, r: 8, t: 32, b: 26 },
        showlegend: false, // there is one legend above all plots
        xaxis: { autorange: true, ticksuffix: suffix, automargin: false },
        hovermode: "x unified",
      };
      const text = `${shown.view} of ${first.joint_names[joint]} along the recording, ${trace.shown} of ${trace.in_range} rows`;
      place.setAttribute("aria-label", text);
      const traces = views[shown.view](trace, joint, x);
      replace(key, legend(traces));
      if (plots.has(joint)) await plots.get(joint).react(traces, layout);
      else {
        plots.set(joint, await plot(place, traces, layout, { label: text, signal }));
        if (signal.aborted) return;
        place.on("plotly_relayout", zoomed);
        linked.add(place);
      }
      if (signal.aborted) return;
    }
    isDrawing = false;
    start.value = String(trace.rows[0]);
    stop.value = String(trace.rows.at(-1));
    replace(rowsNote, shownRows(trace), " ", isWhole() ? null : button("Show all rows", () => showRows(0, null)));
    replace(note, about[shown.view]);
  };
  const isWhole = () => shown.trace.in_range === first.in_range;
  const showRows = async (from, to) => {
    const mine = (requests += 1);
    try {
      const trace = from === 0 && to === null ? first : await fetch(from, to);
      if (mine !== requests || signal.aborted) return;
      shown.trace = trace;
      replace(problem);
      await draw();
    } catch (error) {
      if (error.name !== "AbortError") replace(problem, errorBox(error));
    }
  };
  const zoomed = (change) => {
    if (isDrawing) return;
    if (change["xaxis.autorange"]) {
      if (!isWhole()) showRows(0, null);
      return;
    }
    if (!("xaxis.range[0]" in change)) return;
    const { x } = axis(shown.trace);
    const [low, high] = [change["xaxis.range[0]"], change["xaxis.range[1]"]];
    const within = shown.trace.rows.filter((_row, index) => x[index] >= low && x[index] <= high);
    if (within.length > 1) showRows(within[0], within.at(-1) + 1);
  };

  const form = h(
    "form",
    {
      class: "actions",
      onsubmit: (event) => {
        event.preventDefault();
        showRows(Math.max(0, Number(start.value)), Number(stop.value) + 1);
      },
    },
    field("From row", start),
    field("To row", stop),
    h("button", { type: "submit" }, "Show these rows"),
  );
  replace(
    element,
    h(
      "div",
      { class: "grid" },
      field("Joint", select([ALL, ...first.joint_names], ALL, (joint) => { shown.joint = joint; draw(); })),
      labels.length > 1 ? field("Show", select(labels, shown.view, (view) => { shown.view = view; draw(); })) : null,
    ),
    h("p", { class: "hint" }, note, " ", rowsNote),
    key,
    problem,
    grid,
    h("details", {}, h("summary", {}, "Select rows"), h("p", { class: "hint" }, "Dragging over a plot does the same."), form),
  );
  await plotly();
  await draw();
}

/** Return the legend of the lines and areas. */
function legend(traces) {
  const named = traces.filter((trace) => trace.showlegend !== false);
  return named.map(({ name, colour, filled, opacity = 1 }) => {
    const paint = typeof colour === "number" ? jointVar(colour) : `var(--${colour})`;
    const form = filled ? `height: 0.8rem; opacity: 0.3; background: ${paint}` : `border-top: 3px solid ${paint}; opacity: ${opacity}`;
    return h("span", {}, h("span", { "aria-hidden": "true", style: `display: inline-block; width: 1.6rem; vertical-align: middle; margin-right: 0.4rem; ${form}` }), name);
  });
}

function shownRows(trace) {
  const part = trace.in_range === trace.samples ? "" : ` (rows ${count(trace.rows[0])} to ${count(trace.rows.at(-1))})`;
  if (trace.shown === trace.in_range) return `Showing all ${count(trace.in_range)} samples${part}.`;
  return `Showing ${count(trace.shown)} of ${count(trace.in_range)} samples${part}, evenly spaced; short peaks may be missing. Drag over a plot to zoom in on every sample.`;
}
