// A data set's signals, one plot a quantity over the same axis: one cursor, one zoom, and the part to hold out by dragging.

import { get, path } from "../../api.js";
import { h, replace } from "../../dom.js";
import { count, shortNames } from "../../format.js";
import { Linked } from "../../linked.js";
import { line, plot } from "../../plots.js";
import { field, loading, select } from "../../ui.js";
import { reading } from "./reading.js";
import { holdOut } from "./stretch.js";

const POINTS = 1000;
const ALL = "all joints";
const SAID = { q: "Position", dq: "Velocity", ddq: "Acceleration", tau: "Torque" };
const AXES = { t: "time", rows: "sample number" };
const DRAGS = { zoom: "zooms all plots", hold: "holds that part out" };

/**
 * Draw the signals of a data set into an element.
 * rows: [first, last) that are to be held out, null for none; choose(rows): others were chosen.
 */
export async function motion(element, dataset, { rows, choose, signal }) {
  replace(element, loading("Drawing"));
  const preview = await get(path`/v1/datasets/${dataset.id}/preview`, { points: POINTS }, signal);
  const names = shortNames(dataset.joint_names);
  // episodes may have clocks of their own: against time they would lie on top of each other
  const orderly = preview.columns.every(({ t }) => t.every((value, index) => index === 0 || value >= t[index - 1]));
  const shown = { joint: ALL, axis: orderly ? "t" : "rows" };
  const places = Object.fromEntries(Object.keys(SAID).map((name) => [name, h("div", { class: "strip" })]));
  const plots = new Map();
  const values = reading(preview, names, dataset.report.joint_types, (x) => linked.point(x));
  const held = holdOut(preview, dataset, rows, () => shown.axis, {
    chosen: (stretch, found) => {
      linked.shade(stretch);
      choose(found);
    },
  });
  const linked = new Linked({ zooms: true, moved: values.show, chosen: held.take });

  const draw = async () => {
    for (const [quantity, place] of Object.entries(places)) {
      const columns = preview.columns.filter((each) => each.quantity === quantity);
      const traces = dataset.joint_names.flatMap((joint, index) => {
        if (shown.joint !== ALL && shown.joint !== joint) return [];
        const column = columns.find((each) => each.joint === joint);
        return column ? [line(...broken(column, shown.axis, preview.starts), names[index], index)] : [];
      });
      const derived = dataset.report.derived.includes(quantity) ? ", derived" : "";
      const layout = {
        title: `${SAID[quantity]} ${quantity}${derived}`,
        y: unit(columns[0]?.unit ?? "", dataset.report.joint_types),
        height: 200,
        showlegend: false, // the table of values names the colours
        hovermode: false,
        dragmode: matchMedia("(pointer: coarse)").matches ? false : "zoom",
        margin: { l: 62, r: 10, t: 30, b: 26 }, // the same in each, so that a moment stands at one place in all
        xaxis: { automargin: false, ticksuffix: shown.axis === "t" ? " s" : "" },
        yaxis: { automargin: false, fixedrange: true },
        uirevision: shown.axis, // another joint is seen through the same window
      };
      const label = `${SAID[quantity]} ${quantity} of ${shown.joint} against ${AXES[shown.axis]}`;
      place.setAttribute("aria-label", label);
      if (plots.has(quantity)) plots.get(quantity).react(traces, layout);
      else {
        plots.set(quantity, await plot(place, traces, layout, { label, signal }));
        if (signal.aborted) return;
        linked.add(place);
      }
    }
    values.against(shown.axis, orderly || shown.axis === "rows");
    held.against(shown.axis, orderly || shown.axis === "rows");
  };

  const drag = select(Object.entries(DRAGS), "zoom", (what) => linked.drag(what === "hold"));
  replace(
    element,
    h(
      "div",
      { class: "grid thirds" },
      field("Joint", select([ALL, ...dataset.joint_names], ALL, (joint) => { shown.joint = joint; values.only(joint === ALL ? null : dataset.joint_names.indexOf(joint)); draw(); })),
      field("Against", select(Object.entries(AXES), shown.axis, (axis) => { shown.axis = axis; draw(); })),
      field("Dragging over a plot", drag),
    ),
    h(
      "div",
      { class: "signals" },
      h("div", { class: "beside" }, values.element, held.element),
      h("div", { class: "strips" }, Object.values(places), h("p", { class: "hint" }, h("button", { type: "button", onclick: () => linked.reset() }, "Show all of it"), " ", thinned(preview), " Lines break between episodes.")),
    ),
  );
  await draw();
}

/** Times (or rows) and values with an empty point before each row that begins an episode. */
export function broken(column, axis, starts) {
  const x = [], y = [];
  let next = 0;
  column.rows.forEach((row, index) => {
    let breaks = false;
    while (next < starts.length && starts[next] <= row) breaks = starts[next++] > 0;
    if (breaks && index > 0) {
      x.push(column[axis][index]);
      y.push(null);
    }
    x.push(column[axis][index]);
    y.push(column.values[index]);
  });
  return [x, y];
}

/** Of "rad or m" what the joints have, where their types are known. */
function unit(said, types) {
  const [revolute, prismatic] = said.split(" or ");
  if (types?.every((type) => type === "revolute")) return revolute;
  return types?.every((type) => type === "prismatic") ? prismatic : said;
}

function thinned(preview) {
  const drawn = Math.max(...preview.columns.map((column) => column.rows.length));
  if (drawn >= preview.samples) return `All ${count(preview.samples)} samples are drawn.`;
  return `Each line has ${count(drawn)} points for ${count(preview.samples)} samples: the smallest and the largest of each stretch.`;
}
