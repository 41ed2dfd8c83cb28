// Plots of a data set's signals: positions, velocities, accelerations and torques, with breaks between episodes.

import { get, path } from "../../api.js";
import { h, replace } from "../../dom.js";
import { count, shortNames } from "../../format.js";
import { line, plot, plotly } from "../../plots.js";
import { field, loading, select } from "../../ui.js";

const POINTS = 1000;
const ALL = "all joints";
const SAID = { q: "Position", dq: "Velocity", ddq: "Acceleration", tau: "Torque" };

/** Draw the signals of a data set into an element, with a choice of joint and axis. */
export async function motion(element, dataset, signal) {
  replace(element, loading("Drawing"));
  const preview = await get(path`/v1/datasets/${dataset.id}/preview`, { points: POINTS }, signal);
  const names = shortNames(dataset.joint_names);
  const axes = { t: "time", rows: "sample number" };
  // episodes may have clocks of their own: against time they would lie on top of each other
  const orderly = preview.columns.every(({ t }) => t.every((value, index) => index === 0 || value >= t[index - 1]));
  const shown = { joint: ALL, axis: orderly ? "t" : "rows" };
  const places = Object.fromEntries(Object.keys(SAID).map((name) => [name, h("div", {})]));
  const plots = new Map();

  const draw = async () => {
    for (const [quantity, place] of Object.entries(places)) {
      const columns = preview.columns.filter((each) => each.quantity === quantity);
      const traces = dataset.joint_names.flatMap((joint, index) => {
        if (shown.joint !== ALL && shown.joint !== joint) return [];
        const column = columns.find((each) => each.joint === joint);
        return column ? [line(...broken(column, shown.axis, preview.starts), names[index], index, { hovertemplate: "%{y:.4g}" })] : [];
      });
      const derived = dataset.report.derived.includes(quantity) ? ", derived" : "";
      const layout = {
        title: `${SAID[quantity]} ${quantity}${derived}`,
        x: shown.axis === "t" ? "t, s" : "sample",
        y: unit(columns[0]?.unit ?? "", dataset.report.joint_types),
        height: 310,
        showlegend: true,
        legend: { orientation: "h", y: -0.3, yanchor: "top" },
        uirevision: shown.axis, // another joint is seen through the same window
      };
      const label = `${SAID[quantity]} ${quantity} of ${shown.joint} against ${axes[shown.axis]}`;
      place.setAttribute("aria-label", label);
      if (plots.has(quantity)) plots.get(quantity).react(traces, layout);
      else plots.set(quantity, await plot(place, traces, layout, { label, signal }));
    }
  };

  replace(
    element,
    h(
      "div",
      { class: "grid" },
      field("Joint", select([ALL, ...dataset.joint_names], ALL, (joint) => { shown.joint = joint; draw(); })),
      field("Against", select(Object.entries(axes), shown.axis, (axis) => { shown.axis = axis; draw(); })),
    ),
    h("div", { class: "grid wide" }, Object.values(places)),
    h("p", { class: "hint" }, thinned(preview), " Lines break between episodes. Zooming one plot zooms all."),
  );
  await draw();
  if (!signal.aborted) await link(Object.values(places));
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

/** What is zoomed in one plot is zoomed in all. */
async function link(elements) {
  const Plotly = await plotly();
  for (const element of elements) {
    element.on("plotly_relayout", (change) => {
      const range = change["xaxis.autorange"] ? { "xaxis.autorange": true } : zoomed(change);
      for (const other of range ? elements.filter((each) => each !== element) : []) {
        const now = other.layout.xaxis;
        const same = range["xaxis.autorange"] ? now.autorange : now.range[0] === change["xaxis.range[0]"] && now.range[1] === change["xaxis.range[1]"];
        if (!same) Plotly.relayout(other, range);
      }
    });
  }
}

function zoomed(change) {
  return "xaxis.range[0]" in change ? { "xaxis.range[0]": change["xaxis.range[0]"], "xaxis.range[1]": change["xaxis.range[1]"] } : null;
}
