// All data sets with their worst finding, and the upload.

import { pages } from "../api.js";
import { Await, Button, Card, Empty, Heading, Link, Listing, page, useRead } from "../components.js";
import { ago, count, seconds, when } from "../format.js";
import { html, useEffect, useState } from "../preact.js";
import { WorstFinding } from "./data/findings.js";
import { Uploader } from "./data/upload.js";

const STEP = 100; // data sets that are read at once
const COLUMNS = [
  { label: "Name", value: (row) => row.name, cell: (row) => html`<${Link} to=${`#/data/${row.id}`}>${row.name}<//>` },
  { label: "Worst finding", cell: (row) => html`<${WorstFinding} report=${row.report} />` },
  { label: "Samples", numeric: true, value: (row) => row.report.rows, first: "descending", cell: (row) => count(row.report.rows) },
  { label: "Length", numeric: true, value: (row) => row.report.timing.duration_s, first: "descending", cell: (row) => seconds(row.report.timing.duration_s) },
  { label: "Joints", numeric: true, value: (row) => row.joint_names.length, cell: (row) => row.joint_names.length },
  { label: "Robot", value: (row) => row.report.robot, cell: (row) => row.report.robot ?? "–" },
  { label: "Uploaded", value: (row) => row.created_at, first: "descending", cell: (row) => html`<time datetime=${row.created_at} title=${when(row.created_at)}>${ago(row.created_at)}</time>` },
  { label: "Next", cell: (row) => html`<div class="actions next"><${Link} to=${`#/train?datasets=${row.id}`} label=${`Train on ${row.name}`}>Train<//>${row.report.upload_options && html`<${Link} to=${`#/data/${row.id}?tab=again`} label=${`Read again: ${row.name}`}>Read again<//>`}</div>` },
];

/** The page `#/data`. */
function DataSets({ title, signal }) {
  useEffect(() => title("Data sets"), []);
  const [most, setMost] = useState(STEP);
  const reading = useRead((stop) => pages("/v1/datasets", most, {}, stop), [most]);
  const words = (row) => [row.name, row.report.robot, row.id, ...row.joint_names].join(" ");
  const simulated = html`No recordings yet. Upload one above, or simulate one: <code>lipserve simulate panda panda.csv</code>`;
  return html`<${Heading} text="Data sets">${reading.value?.length > 0 && html`<${Link} to="#/train" kind="primary">Train a model<//>`}<//>
    <${Uploader} onuploaded=${reading.reload} signal=${signal} />
    <${Card} title="Recordings"><${Await} reading=${reading}>${(found) => (found.length === 0 ? html`<${Empty} text=${simulated} />` : html`
      <div class="datasets"><${Listing} columns=${COLUMNS} rows=${found} caption="Recordings" what=${["recording", "recordings"]} identity=${(row) => row.id} words=${words} minRows=${4} /></div>
      ${found.length === most && html`<${Button} onclick=${() => setMost(most + STEP)}>Show older<//>`}`)}<//><//>`;
}

export const render = page(DataSets);
