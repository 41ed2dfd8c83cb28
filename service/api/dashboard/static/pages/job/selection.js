// How `auto` selected the estimator of a version.

import { Card, Table } from "../../components.js";
import { counted, number, percent, scientific, sentence } from "../../format.js";
import { html } from "../../preact.js";

/** The card, if `auto` selected the estimator. */
export function Selection({ version: { selection } }) {
  if (!selection) return null;
  const { chosen, reason, held_out: held, table: rows } = selection;
  return html`<${Card} title="Selection of the estimator">
    <p><strong>${chosen}</strong>: ${sentence(reason)}</p>
    ${held.repeats && html`<p class="banner">The held-out motion repeats the training motion, so all figures are optimistic except those at the edge.</p>`}
    ${held.blocks > 0 && html`<${Comparison} chosen=${chosen} rows=${rows} held=${held} />`}
    ${rows.filter((each) => each.error).map((each) => html`<p class="hint" key=${each.estimator}>${each.estimator} could not be trained: ${each.error}</p>`)}
    ${held.blocks > 0 && html`<p class="hint">A higher log density means better predictions and more accurate uncertainty. The first estimator is selected unless a later one has a significantly higher log density and no larger error, also at the edge of the data. The selected estimator was then trained on all samples.</p>`}
  <//>`;
}

function Comparison({ chosen, rows, held }) {
  const columns = [
    { label: "Estimator", cell: (row) => (row.estimator === chosen ? html`<strong>${row.estimator}</strong>` : row.estimator) },
    { label: "Log density, nats per sample", numeric: true, cell: (row) => number(row.log_density) },
    { label: "Difference from the best", numeric: true, cell: difference },
    { label: "nMSE, mean over joints", numeric: true, cell: (row) => scientific(mean(row.nmse)) },
    { label: "nMSE at the edge", numeric: true, cell: (row) => scientific(mean(row.edge_nmse)) },
    { label: "95\u00a0% coverage", numeric: true, cell: (row) => percent(mean(row.coverage)) },
  ];
  const caption = `Evaluated on ${counted(held.blocks, "held-out segment")} (${counted(held.rows, "sample")}), ${held.edge_blocks} of them at the edge of the data`;
  return html`<${Table} columns=${columns} rows=${rows} caption=${caption} identity=${(row) => row.estimator} />`;
}

function difference({ difference: from, standard_error: error }) {
  if (from === null) return "–";
  return error === null ? number(-from || 0) : `${number(-from)} ± ${number(error, 2)}`;
}

function mean(values) {
  const known = (values ?? []).filter((each) => each !== null);
  return known.length ? known.reduce((sum, each) => sum + each, 0) / known.length : null;
}
