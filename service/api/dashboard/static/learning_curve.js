// Learning curve of a version: error on held-out samples against training samples; shown with the version and its job.

import { Card, Drawn, Table } from "./components.js";
import { Export } from "./exporting.js";
import { count, nmse } from "./format.js";
import { line, plot } from "./plots.js";
import { html } from "./preact.js";

/** The card, if the version has a learning curve. */
export function LearningCurve({ version }) {
  const curve = version.lineage.holdout?.learning_curve;
  if (!curve) return null;
  const { points } = curve;
  const columns = [
    { label: "Training samples", numeric: true, cell: (row) => count(row.rows) },
    { label: "Chosen", cell: (row) => chosen(row, points) },
    { label: "nMSE, mean over joints", numeric: true, cell: (row) => nmse(row.nmse) },
  ];
  const table = () => [["training samples", "chosen", "nMSE"], ...points.map((row) => [row.rows, chosen(row, points), row.nmse])];
  return html`<${Card} title="Learning curve">
    <p>${curve.text}</p>
    ${points.length > 0 && html`
      <${Drawn} draw=${(place, signal) => draw(place, points, signal)} inputs=${[version.version]} />
      <${Export} name=${`learning curve of ${version.model} ${version.version}`} table=${table} />
      <details><summary>Numbers</summary><${Table} columns=${columns} rows=${points} caption="Error on the held-out samples" /></details>`}
  <//>`;
}

function draw(place, points, signal) {
  const spread = points.filter((each) => each.spread), others = points.filter((each) => !each.spread && each !== points.at(-1));
  const curve = [...spread, ...(points.at(-1).spread ? [] : [points.at(-1)])];
  const trace = (rows, name, colour, extra) => line(rows.map((each) => each.rows), rows.map((each) => each.nmse), name, colour, { mode: "lines+markers", marker: { size: 7 }, hovertemplate: "%{y:.2~g}", ...extra });
  const traces = [trace(curve, "spread over the recordings", "accent", {})];
  if (others.length) traces.push(trace(others, "the first ones", "novel", { mode: "markers", marker: { size: 9, symbol: "diamond" } }));
  const layout = {
    x: "training samples",
    y: "nMSE, held out",
    height: 260,
    showlegend: others.length > 0,
    xaxis: { rangemode: "tozero", nticks: 6 },
    yaxis: { rangemode: "tozero", nticks: 5 },
  };
  const label = `nMSE against training samples: ${points.map((each) => `${nmse(each.nmse)} with ${each.rows}`).join(", ")}`;
  return plot(place, traces, layout, { label, signal });
}

function chosen(row, points) {
  if (row === points.at(-1)) return "all";
  return row.spread ? "spread over the recordings" : "the first ones";
}
