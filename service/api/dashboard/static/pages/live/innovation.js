// Plot of the innovation in standard deviations, with marks of rejected and novel rows.

import { css } from "../../colours.js";
import { Card } from "../../components.js";
import { shortNames } from "../../format.js";
import { line } from "../../plots.js";
import { html } from "../../preact.js";
import { CODES, NOVEL } from "./codes.js";
import { Explanation } from "./explanation.js";
import { LivePlot } from "./live_plot.js";
import { innovationOf } from "./scores.js";
import { HALF_WIDTH, span, thin, withGaps } from "./torque.js";

const HEIGHT = 300;
const MIN_RANGE_STD = 4;
const MAX_RANGE_STD = 12;
const MAX_MARKS = 150; // of each kind

/** The innovation of all joints; joint: highlighted one; threshold: of contacts, in standard deviations. */
export function Innovation({ shown, joints, window, threshold, joint, linked }) {
  const range = [-span(shown, window), 0];
  const label = `Innovation of all joints over the last ${-range[0]} seconds, with marks of rejected rows`;
  return html`<${Card} title="Innovation" term="innovation">
    <${LivePlot} make=${() => innovation(shown, joints, range, threshold, joint)} inputs=${[shown, joint]} height=${HEIGHT} label=${label} linked=${linked} />
    <${Explanation}>Measured − predicted torque, in standard deviations of a measurement. 95 % of the rows should lie between the dotted lines at ± ${HALF_WIDTH}. Symbols mark rejected rows and rows outside the training data, at the joint with the largest innovation. Values beyond ± ${MAX_RANGE_STD} are drawn at ± ${MAX_RANGE_STD}.<//>
  <//>`;
}

function innovation(rows, joints, range, threshold, highlighted) {
  const short = shortNames(joints);
  const worst = rows.map(largestInnovation);
  const top = Math.min(MAX_RANGE_STD, Math.max(MIN_RANGE_STD, 1.1 * worst.reduce((most, z) => Math.max(most, Math.abs(z)), 0)));
  const clip = (z) => (z === null ? null : Math.max(-top, Math.min(top, z)));
  const thinned = thin(rows);
  const x = withGaps(thinned, (row) => row.x);
  const curves = joints.map((_name, joint) =>
    line(x, withGaps(thinned, (row) => clip(innovationOf(row, joint))), short[joint], joint, { line: { width: joint === highlighted ? 2.2 : 0.8 }, showlegend: false }),
  );
  const layout = {
    y: "σ", height: HEIGHT, margin: { l: 52, r: 8, t: 8, b: 40 }, hovermode: false, dragmode: false,
    xaxis: { range, zeroline: false, ticksuffix: " s", automargin: false },
    yaxis: { range: [-1.05 * top, 1.05 * top], automargin: false },
    showlegend: true, // for the marks only: the plots above name the joint colours
    legend: { orientation: "h", y: -0.16, yanchor: "top", itemclick: false, itemdoubleclick: false },
    shapes: limits(threshold, top),
  };
  return { traces: [...curves, ...marks(rows, worst, clip)], layout };
}

/** Return the largest innovation of a row; 0 if nothing was predicted. */
function largestInnovation(row) {
  return row.tau.reduce((most, _tau, joint) => {
    const z = innovationOf(row, joint);
    return z !== null && Math.abs(z) > Math.abs(most) ? z : most;
  }, 0);
}

function marks(rows, worst, clip) {
  const kinds = new Map();
  const add = (kind, row, z) => {
    if (!kinds.has(kind)) kinds.set(kind, { x: [], y: [] });
    const found = kinds.get(kind);
    found.x.push(row.x);
    found.y.push(clip(z));
  };
  rows.forEach((row, index) => {
    if (row.code !== "learnt") add(CODES[row.code] ?? { words: row.code, symbol: "cross", colour: "contact" }, row, worst[index]);
    if (row.novel) add(NOVEL, row, worst[index]);
  });
  return [...kinds].map(([kind, data]) => ({
    ...limitMarks(data), mode: "markers", type: "scatter", name: kind.words, colour: kind.colour,
    marker: kind.lasting ? { symbol: kind.symbol, size: 4, opacity: 0.6 } : { symbol: kind.symbol, size: 8 },
  }));
}

function limitMarks(data) {
  const step = Math.ceil(data.x.length / MAX_MARKS);
  return Object.fromEntries(Object.entries(data).map(([name, values]) => [name, values.filter((_value, index) => index % step === 0)]));
}

function limits(contact, top) {
  const across = (y, colour, dash) => ({ type: "line", xref: "paper", x0: 0, x1: 1, y0: y, y1: y, line: { color: css(colour), width: 1, dash } });
  const found = [-HALF_WIDTH, HALF_WIDTH].map((y) => across(y, "muted", "dot"));
  return contact > top ? found : [...found, ...[-contact, contact].map((y) => across(y, "contact", "dash"))];
}
