// How `auto` selected the estimator of a version; shown with the version and its job.

import { h } from "../../dom.js";
import { counted, number, percent, scientific, sentence } from "../../format.js";
import { card, table } from "../../ui.js";

/** Return the card; null if the estimator was not selected by `auto`. */
export function selectionCard({ selection }) {
  if (!selection) return null;
  const { held_out: held, table: rows } = selection;
  const failed = rows.filter((each) => each.error);
  return card(
    "Selection of the estimator",
    h("p", {}, h("strong", {}, selection.chosen), `: ${sentence(selection.reason)}`),
    held.repeats ? h("p", { class: "banner" }, "The held-out motion repeats the training motion, so all figures are optimistic except those at the edge.") : null,
    held.blocks ? comparisonTable(selection, held) : null,
    failed.map((each) => h("p", { class: "hint" }, `${each.estimator} could not be trained: ${each.error}`)),
    held.blocks ? h("p", { class: "hint" }, "A higher log density means better predictions and more accurate uncertainty. The first estimator is selected unless a later one has a significantly higher log density and no larger error, also at the edge of the data. The selected estimator was then trained on all samples.") : null,
  );
}

function comparisonTable({ chosen, table: rows }, held) {
  const segments = counted(held.blocks, "held-out segment");
  const columns = [
    { label: "Estimator", cell: (row) => (row.estimator === chosen ? h("strong", {}, row.estimator) : row.estimator) },
    { label: "Log density, nats per sample", numeric: true, cell: (row) => shown(row.log_density, number) },
    { label: "Difference from the best", numeric: true, cell: (row) => differenceText(row) },
    { label: "nMSE, mean over joints", numeric: true, cell: (row) => shown(mean(row.nmse), scientific) },
    { label: "nMSE at the edge", numeric: true, cell: (row) => shown(mean(row.edge_nmse), scientific) },
    { label: "95 % coverage", numeric: true, cell: (row) => shown(mean(row.coverage), percent) },
  ];
  return table(columns, rows, { caption: `Evaluated on ${segments} (${counted(held.rows, "sample")}), ${held.edge_blocks} of them at the edge of the data` });
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
