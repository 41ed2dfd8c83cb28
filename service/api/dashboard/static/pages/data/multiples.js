// Draws small plots of signals: one column for each quantity, in it one plot for each joint, with its own scale.

import { number } from "../../format.js";
import { LinkedPlots } from "../../linked.js";
import { line, plot } from "../../plots.js";
import { useEffect, useRef } from "../../preact.js";

/** Quantities in the order of the columns, and their names. */
export const QUANTITIES = [["q", "Position"], ["dq", "Velocity"], ["ddq", "Acceleration"], ["tau", "Torque"]];
const NAME_HEIGHT = 24, GAP = 8, BELOW = 24; // px above, below, and of the axis
const LEFT = 46, CHARACTER = 8; // px: least margin for the labels, width of a character
const MIDDLE = [0.25, 0.75]; // where the label of zero fits between those of the ends

/**
 * Draw a SignalSet. joints: shown ones; axis: "t" or "rows"; stretch: shaded range; dragging: whether dragging selects a range;
 * moved(x), chosen(range): as of LinkedPlots. Returns {places, point(x), reset()}; places: refs, one for each quantity.
 */
export function useMultiples(signals, { joints, axis, stretch, dragging, moved, chosen }) {
  const places = QUANTITIES.map(() => useRef(null));
  const told = useRef({});
  told.current = { moved, chosen };
  const state = useRef(null);
  useEffect(() => {
    const stop = new AbortController();
    const linked = new LinkedPlots({ zooms: true, moved: (x) => told.current.moved(x), chosen: (range) => told.current.chosen(range) });
    state.current = { linked, plots: new Map(), signal: stop.signal };
    return () => stop.abort();
  }, []);
  useEffect(() => {
    draw(state.current, places.map((each) => each.current), signals, joints, axis).catch((error) => state.current.signal.aborted || console.error(error));
  }, [joints.join(), axis]);
  useEffect(() => state.current.linked.shade(stretch), [stretch?.join()]);
  useEffect(() => state.current.linked.drag(dragging), [dragging]);
  return { places, point: (x) => state.current.linked.point(x), reset: () => state.current.linked.reset() };
}

async function draw(state, places, signals, joints, axis) {
  for (const [index, [quantity, name]] of QUANTITIES.entries()) {
    const place = places[index];
    const shown = joints.filter((joint) => signals.column(quantity, joint));
    const traces = shown.map((joint) => line(...signals.line(quantity, joint, axis), signals.names[joint], joint, { yaxis: axisName("y", joints.indexOf(joint)) }));
    const layout = layoutOf(signals, quantity, joints, axis);
    const label = `${name} ${quantity} of ${joints.map((joint) => signals.names[joint]).join(", ")} against ${axis === "t" ? "time" : "sample number"}`;
    place.setAttribute("aria-label", label);
    if (state.plots.has(quantity)) state.plots.get(quantity).react(traces, layout);
    else {
      state.plots.set(quantity, await plot(place, traces, layout, { label, signal: state.signal }));
      if (state.signal.aborted) return;
      state.linked.add(place);
    }
  }
}

/** Return a layout with one y axis for each joint, below each other, and a common x axis. */
function layoutOf(signals, quantity, joints, axis) {
  const row = signals.rowHeight(joints.length), height = row * joints.length;
  const domain = (index) => [1 - ((index + 1) * row - GAP) / height, 1 - (index * row + NAME_HEIGHT) / height];
  const axes = joints.map((_joint, index) => [axisName("yaxis", index), { domain: domain(index), automargin: false, fixedrange: true, zeroline: false, ...ends(signals.column(quantity, joints[index])) }]);
  const longest = Math.max(0, ...axes.flatMap(([, { ticktext = [] }]) => ticktext.map((each) => each.length)));
  return {
    ...Object.fromEntries(axes),
    height: height + BELOW,
    showlegend: false, // each plot has its name above it
    hovermode: false,
    dragmode: matchMedia("(pointer: coarse)").matches ? false : "zoom",
    margin: { l: Math.max(LEFT, CHARACTER * longest + 4), r: 6, t: 0, b: BELOW },
    xaxis: { automargin: false, nticks: 5, anchor: axisName("y", joints.length - 1), ticksuffix: axis === "t" ? " s" : "" },
    uirevision: axis, // keeps the zoom when the joint changes
    meta: joints.map((joint, index) => ({ text: `${signals.names[joint]}: ${quantity}, ${signals.unit(quantity, joint) || signals.units(quantity)}`, x: 0, y: domain(index)[1] })),
  };
}

/** Return ticks at the smallest and largest value, and at zero if there is room: each small plot shows its scale. */
function ends(column) {
  if (!column) return {};
  const [low, high] = [Math.min(...column.values), Math.max(...column.values)];
  const zero = -low / (high - low);
  const ticks = low === high ? [low] : zero > MIDDLE[0] && zero < MIDDLE[1] ? [low, 0, high] : [low, high];
  return { tickmode: "array", tickvals: ticks, ticktext: ticks.map((each) => number(each, 2)) };
}

function axisName(kind, index) {
  return index ? `${kind}${index + 1}` : kind;
}
