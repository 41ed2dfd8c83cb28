// How `auto` selected the estimator of a version; shown with the version and its job.

import { Card, Table } from "./components.js";
import { counted, number, percent, scientific, sentence } from "./format.js";
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
