// How a version was trained: the selection of its estimator and its learning curve; shown with the version and its job.

import { jointVar } from "./colours.js";
import { Card, Table } from "./components.js";
import { count, counted, nmse, number, percent, scientific, sentence } from "./format.js";
import { html } from "./preact.js";

/** How `auto` selected the estimator; nothing if the request named it. */
export function SelectionCard({ version: { selection } }) {
  if (!selection) return null;
  const { chosen, reason, held_out: held, table: rows } = selection;
  const columns = [
    { label: "Estimator", cell: (row) => (row.estimator === chosen ? html`<strong>${row.estimator}</strong>` : row.estimator) },
    { label: "Log density, nats per sample", numeric: true, cell: (row) => shown(row.log_density, number) },
    { label: "Difference from the best", numeric: true, cell: differenceText },
    { label: "nMSE, mean over joints", numeric: true, cell: (row) => shown(mean(row.nmse), scientific) },
    { label: "nMSE at the edge", numeric: true, cell: (row) => shown(mean(row.edge_nmse), scientific) },
    { label: "95 % coverage", numeric: true, cell: (row) => shown(mean(row.coverage), percent) },
  ];
  const caption = `Evaluated on ${counted(held.blocks, "held-out segment")} (${counted(held.rows, "sample")}), ${held.edge_blocks} of them at the edge of the data`;
  return html`<${Card} title="Selection of the estimator">
    <p><strong>${chosen}</strong>: ${sentence(reason)}</p>
    ${held.repeats && html`<p class="banner">The held-out motion repeats the training motion, so all figures are optimistic except those at the edge.</p>`}
    ${held.blocks > 0 && html`<${Table} columns=${columns} rows=${rows} caption=${caption} />`}
    ${rows.filter((each) => each.error).map((each) => html`<p class="hint">${each.estimator} could not be trained: ${each.error}</p>`)}
    ${held.blocks > 0 && html`<p class="hint">A higher log density means better predictions and more accurate uncertainty. The first estimator is selected unless a later one has a significantly higher log density and no larger error, also at the edge of the data. The selected estimator was then trained on all samples.</p>`}
  <//>`;
}

/** Error on the held-out samples against training samples; nothing if the version has no learning curve. */
export function LearningCurveCard({ version: { lineage } }) {
  const curve = lineage.holdout?.learning_curve;
  if (!curve) return null;
  const chosen = (row) => (row === curve.points.at(-1) ? "all" : row.spread ? "spread over the recordings" : "the first ones");
  const columns = [
    { label: "Training samples", numeric: true, cell: (row) => count(row.rows) },
    { label: "Chosen", cell: chosen },
    { label: "nMSE, mean over joints", numeric: true, cell: (row) => nmse(row.nmse) },
  ];
  return html`<${Card} title="Learning curve">
    <p>${curve.text}</p>
    ${curve.points.length > 0 && html`<${Curve} points=${curve.points.filter((each) => each.spread)} /><${Table} columns=${columns} rows=${curve.points} caption="Error on the held-out samples" />`}
  <//>`;
}

/** Errors against rows, both on logarithmic scales that start at the smallest value. */
function Curve({ points }) {
  const [rows, errors] = [points.map((each) => each.rows), points.map((each) => each.nmse)];
  const [x, y] = [scale(rows, 1, 99), scale(errors, 39, 1)];
  const label = `nMSE against rows: ${rows.map((each, index) => `${nmse(errors[index])} with ${each}`).join(", ")}`;
  return html`<svg class="course" role="img" aria-label=${label} viewBox="0 0 100 40" preserveAspectRatio="none">
    <title>${label}</title><path d=${`M${rows.map((each, index) => `${x(each).toFixed(2)} ${y(errors[index]).toFixed(2)}`).join("L")}`} stroke=${jointVar(0)} />
  </svg>`;
}

/** Return the map of values, on a logarithmic scale, to a range of numbers; its middle if all are equal. */
function scale(values, first, last) {
  const [low, high] = [Math.log(Math.min(...values)), Math.log(Math.max(...values))];
  return (value) => (high > low ? first + ((last - first) * (Math.log(value) - low)) / (high - low) : (first + last) / 2);
}

function differenceText({ difference, standard_error: error }) {
  if (difference === null) return "–";
  return error === null ? number(-difference || 0) : `${number(-difference)} ± ${number(error, 2)}`;
}

function mean(values) {
  const known = (values ?? []).filter((each) => each !== null);
  return known.length ? known.reduce((sum, each) => sum + each, 0) / known.length : null;
}

function shown(value, format) {
  return value === null ? "–" : format(value);
}
