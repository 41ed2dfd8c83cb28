// Small plots of a trace, one for each joint, with a common zoom. If rows are skipped, zooming loads them.

import { jointVar } from "../../colours.js";
import { Button, Choice, ErrorBox, Field, useRead } from "../../components.js";
import { Export } from "../../exporting.js";
import { count, shortNames, timeOrigin, torqueUnit } from "../../format.js";
import { Joint } from "../../jointbars.js";
import { LinkedPlots } from "../../linked.js";
import { Plot } from "../../plotted.js";
import { html, useEffect, useMemo, useRef, useState } from "../../preact.js";
import { axis } from "./curves.js";

const ALL = "all joints";

/**
 * A trace as plots, one for each joint. first: trace of all rows; fetch({start, stop}, signal): read the trace of some rows;
 * views: {label: (trace, joint, x) => traces}, of which one is shown; about: {label: explanation}; types: of the joints;
 * name: of exported files; numbers: (trace, joint) => {heading: values}, their columns.
 */
export function JointPlots({ first, fetch, views, about, types, name: title, numbers }) {
  const { joint_names: joints } = first, names = shortNames(joints), labels = Object.keys(views);
  const [joint, setJoint] = useState(ALL), [view, setView] = useState(labels[0]), [rows, setRows] = useState(null);
  const read = useRead(async (signal) => (rows ? fetch(rows, signal) : first), [first, rows]);
  const trace = read.value ?? first, { x, suffix, isCut } = axis(trace, timeOrigin(first.t[0]));
  const linked = useMemo(() => new LinkedPlots({ stays: false }), []);
  const shown = useRef(null);
  shown.current = { trace, x, rows };
  const zoomed = (change) => {
    const now = shown.current;
    if (change["xaxis.autorange"] && now.rows) setRows(null);
    const [low, high] = [change["xaxis.range[0]"], change["xaxis.range[1]"]];
    if (low === undefined) return;
    const within = now.trace.rows.filter((_row, index) => now.x[index] >= low && now.x[index] <= high);
    if (within.length > 1) setRows({ start: within[0], stop: within.at(-1) + 1 });
  };
  const drawn = (place) => {
    linked.add(place);
    place.on("plotly_relayout", zoomed);
  };
  const alone = joint !== ALL;
  const one = (name, index) => {
    const layout = {
      y: torqueUnit(types?.[index]), height: alone ? 400 : 190, margin: { l: 52, r: 8, t: 8, b: 26 }, showlegend: false,
      xaxis: { autorange: true, ticksuffix: suffix, automargin: false }, hovermode: "x unified",
    };
    const hidden = alone && joint !== name;
    return html`<div key=${name} hidden=${hidden}>
      <${Joint} index=${index} name=${names[index]} />
      <${Plot} draw=${() => [views[view](trace, index, x), layout]} inputs=${[trace, view, alone]} hidden=${hidden} ondrawn=${drawn}
        label=${`${view} of ${name} along the recording, ${trace.shown} of ${trace.in_range} rows`} />
    </div>`;
  };
  const table = () => tableOf(trace, joints.filter((each) => !alone || each === joint), (name) => torqueUnit(types?.[joints.indexOf(name)]), (name) => numbers(trace, joints.indexOf(name)));
  return html`
    <div class="grid">
      <${Choice} label="Joint" options=${[ALL, ...joints]} value=${joint} onchange=${setJoint} />
      ${labels.length > 1 && html`<${Choice} label="Show" options=${labels} value=${view} onchange=${setView} />`}
    </div>
    <p class="hint">${about[view]} ${shownRows(trace)} ${isCut && "Long pauses are cut. "}${rows && html`<${Button} onclick=${() => setRows(null)}>Show all rows<//>`}</p>
    <${Legend} traces=${views[view](trace, 0, x)} />
    ${read.error && html`<${ErrorBox} error=${read.error} />`}
    <div class="joint-plots">${joints.map(one)}</div>
    <${Export} name=${title} table=${table} />
    <${RowsForm} trace=${trace} choose=${setRows} />`;
}

/** Return the shown rows of joints as a table. unit(joint): of its torque; columns(joint): {heading: values}. */
function tableOf(trace, joints, unit, columns) {
  const parts = joints.map((joint) => [joint, Object.entries(columns(joint))]);
  const rows = parts.flatMap(([joint, found]) => trace.rows.map((row, index) => [joint, unit(joint), row, trace.t[index], ...found.map(([, values]) => values[index])]));
  return [["joint", "unit", "row", "time, s", ...parts[0][1].map(([heading]) => heading)], ...rows];
}

function RowsForm({ trace, choose }) {
  const [ends, setEnds] = useState([]);
  useEffect(() => setEnds([trace.rows[0], trace.rows.at(-1)]), [trace]);
  const submit = (event) => {
    event.preventDefault();
    choose({ start: Math.max(0, Number(ends[0])), stop: Number(ends[1]) + 1 });
  };
  const input = (end) => (attributes) => html`<input ...${attributes} type="number" min="0" step="1" required value=${ends[end]} onInput=${(event) => setEnds(ends.with(end, event.target.value))} />`;
  return html`<details>
    <summary>Select rows</summary>
    <p class="hint">Dragging over a plot does the same.</p>
    <form class="actions" onSubmit=${submit}>
      <${Field} label="From row" input=${input(0)} /><${Field} label="To row" input=${input(1)} />
      <button type="submit">Show these rows</button>
    </form>
  </details>`;
}

/** The legend above all plots. */
function Legend({ traces }) {
  const sample = ({ name, colour, filled, opacity = 1 }) => {
    const paint = typeof colour === "number" ? jointVar(colour) : `var(--${colour})`;
    const form = filled ? `height: 0.8rem; opacity: 0.3; background: ${paint}` : `height: 3px; opacity: ${opacity}; background: ${paint}`;
    return html`<span><i class="sample" style=${form}></i>${name}</span>`;
  };
  return html`<p class="key">${traces.filter((trace) => trace.showlegend !== false).map(sample)}</p>`;
}

function shownRows(trace) {
  const part = trace.in_range === trace.samples ? "" : ` (rows ${count(trace.rows[0])} to ${count(trace.rows.at(-1))})`;
  if (trace.shown === trace.in_range) return `Showing all ${count(trace.in_range)} samples${part}.`;
  return `Showing ${count(trace.shown)} of ${count(trace.in_range)} samples${part}, evenly spaced; short peaks may be missing. Drag over a plot to zoom in on every sample.`;
}
