// All data sets, and the upload.

import { get } from "../api.js";
import { h, refresh, replace } from "../dom.js";
import { ago, count, counted, number, seconds, when } from "../format.js";
import { badge, button, card, empty, heading, link, notice, table } from "../ui.js";
import { robots } from "./data/robots.js";
import { uploader } from "./data/upload.js";

/** The page `#/data`. */
export async function render(view, params, { signal, title }) {
  title("Data sets");
  const list = h("div", {});
  const found = [];
  let cursor = null;
  const more = button("Show older", () => load(cursor));

  const load = async (after = null) => {
    const page = await get("/v1/datasets", { cursor: after }, signal);
    if (after === null) found.length = 0;
    found.push(...page.items);
    cursor = page.next_cursor;
    refresh(list, found.length ? datasetTable(found) : emptyState(), cursor ? more : null);
  };
  const { element, fillRobots } = uploader({ onUploaded: () => load(), signal });
  await load();
  replace(view, heading("Data sets", found.length ? link("Train a model", "#/train", "primary") : null), element, card("Recordings", list));
  // uploads work without the list of robots
  robots(signal).then(fillRobots, (error) => error.name === "AbortError" || notice(`The robots could not be loaded: ${error.message}`, "bad"));
}

function datasetTable(datasets) {
  return table(
    [
      { label: "Name", cell: (row) => link(row.name, `#/data/${row.id}`) },
      { label: "Findings", cell: (row) => findings(row.report) },
      { label: "Samples", numeric: true, cell: (row) => count(row.report.rows) },
      { label: "Rate, Hz", numeric: true, cell: (row) => number(row.report.rate_hz, 4) },
      { label: "Length", numeric: true, cell: (row) => seconds(row.report.timing.duration_s) },
      { label: "Joints", numeric: true, cell: (row) => row.joint_names.length },
      { label: "Robot", cell: (row) => row.report.robot ?? "–" },
      { label: "Uploaded", cell: (row) => h("time", { datetime: row.created_at, title: when(row.created_at) }, ago(row.created_at)) },
      { label: "Next", cell: (row) => link("Train", `#/train?datasets=${row.id}`) },
    ],
    datasets,
    { caption: "Newest first", key: (row) => row.id },
  );
}

function findings(report) {
  if (report.warnings.length) return badge(counted(report.warnings.length, "warning"), "warn");
  return report.advice.length ? badge(counted(report.advice.length, "recommendation"), "plain") : badge("no issues", "good");
}

function emptyState() {
  return empty(
    [
      "No recordings yet. Upload one above, or simulate one: ",
      h("code", {}, "lipserve simulate panda panda.csv"),
    ],
  );
}
