// Learning curve of a version: held-out error against training samples; shown with the version and its job.

import { errorCurve } from "../../charts.js";
import { h } from "../../dom.js";
import { count, nmse } from "../../format.js";
import { card, table } from "../../ui.js";

/** Return the card; null if the version has no learning curve. */
export function learningCurveCard({ lineage }) {
  const curve = lineage.holdout?.learning_curve;
  if (!curve) return null;
  if (!curve.points.length) return card("Learning curve", h("p", {}, curve.text));
  const columns = [
    { label: "Training samples", numeric: true, cell: (row) => count(row.rows) },
    { label: "Chosen", cell: (row) => chosen(row, curve) },
    { label: "nMSE, mean over joints", numeric: true, cell: (row) => nmse(row.nmse) },
  ];
  const spread = curve.points.filter((each) => each.spread);
  return card(
    "Learning curve",
    h("p", {}, curve.text),
    errorCurve(spread.map((each) => each.rows), spread.map((each) => each.nmse)),
    table(columns, curve.points, { caption: "Error on the held-out samples" }),
  );
}

function chosen(row, { points }) {
  if (row === points.at(-1)) return "all";
  return row.spread ? "spread over the recordings" : "the first ones";
}
