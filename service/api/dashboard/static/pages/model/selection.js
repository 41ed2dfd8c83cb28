// How `auto` has chosen a version's estimator: a small table, shown with the version and with the job that made it.

import { h } from "../../dom.js";
import { counted, number, percent, scientific } from "../../format.js";
import { card, table } from "../../ui.js";

/** The card of a choice; null where the estimator was named. */
export function selectionCard({ selection }) {
  if (!selection) return null;
  const { held_out: held, table: rows } = selection;
  const failed = rows.filter((each) => each.error);
  return card(
    "How the estimator was chosen",
    h("p", {}, h("strong", {}, selection.chosen), `: ${selection.reason}.`),
    held.repeats ? h("p", { class: "banner" }, "The held-out motion repeats the training motion: all figures flatter, except those at the edge.") : null,
    held.blocks ? judged(selection, held) : null,
    failed.map((each) => h("p", { class: "hint" }, `${each.estimator} could not be trained: ${each.error}`)),
    held.blocks ? h("p", { class: "hint" }, "A higher log density means better predictions and truer uncertainty. The first estimator is chosen unless a later one has a higher log density beyond chance and no larger error, also at the edge of the data. The chosen estimator was then trained on the held-out samples, too.") : null,
  );
}

function judged({ chosen, table: rows }, held) {
  const stretches = counted(held.blocks, "stretch", "stretches");
  const columns = [
    { label: "Estimator", cell: (row) => (row.estimator === chosen ? h("strong", {}, row.estimator) : row.estimator) },
    { label: "Log density, nats a sample", numeric: true, cell: (row) => shown(row.log_density, number) },
    { label: "Less than the best", numeric: true, cell: (row) => less(row) },
    { label: "nMSE, mean of the joints", numeric: true, cell: (row) => shown(mean(row.nmse), scientific) },
    { label: "nMSE at the edge", numeric: true, cell: (row) => shown(mean(row.edge_nmse), scientific) },
    { label: "Within the 95 % band", numeric: true, cell: (row) => shown(mean(row.coverage), percent) },
  ];
  return table(columns, rows, { caption: `Judged on ${stretches} held out (${counted(held.rows, "sample")}), ${held.edge_blocks} at the edge of the data` });
}

function less({ difference, standard_error: error }) {
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
