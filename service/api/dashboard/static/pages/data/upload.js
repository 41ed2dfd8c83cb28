// Upload of recordings, one after the other, chosen by a button or dropped on the page.

import { missingExtraHint } from "../../extras.js";
import { upload } from "../../api.js";
import { h, replace } from "../../dom.js";
import { bytes, counted, sentence } from "../../format.js";
import { button, card, field, link, notice, progress } from "../../ui.js";
import { describeOptions, uploadOptions, withOption } from "./options.js";
import { uploadError } from "./upload_error.js";

const EXTENSIONS = ".csv,.tsv,.txt,.npz,.parquet,.pq,.ndjson,.jsonl,.json,.db3,.bag,.mcap,.zip,.feather,.arrow,.h5,.hdf5,.mat,.npy,.xlsx,.yaml,.yml,.gz,.zst";

/** Create the upload card. onUploaded(dataset) is called after each upload. Returns {element, fillRobots(robots)}. */
export function uploader({ onUploaded, signal }) {
  const options = uploadOptions();
  const name = h("input", { type: "text", name: "name", maxlength: "200", autocomplete: "off" });
  const named = field("Name", name, "Default: the name of the file.");
  const input = h("input", { type: "file", multiple: true, accept: EXTENSIONS, "aria-label": "Recordings to upload", hidden: true });
  const choose = button("Choose files", () => input.click());
  const zone = h(
    "div",
    { class: "empty" },
    h("p", {}, "Drop recordings anywhere on this page, or choose files."),
    h("div", { class: "actions" }, choose, input),
    h("p", { class: "hint" }, "CSV, Excel, Parquet, HDF5, MATLAB, NumPy, JSON, rosbag1, rosbag2, MCAP, LeRobot (zip), also compressed. Required columns: time, position and torque."),
    missingExtraHint("ingest"),
  );
  const ready = h("div", { hidden: true });
  const as = h("p", { class: "hint" });
  // options are kept after an upload: show how the next file will be read
  const describe = () => {
    const values = options.values();
    as.textContent = Object.keys(values).length ? `Import options: ${describeOptions(values)}.` : "The contents are detected automatically. To override this, set the import options below.";
  };
  options.element.addEventListener("change", describe);
  const outcomes = h("div", {});
  let chosen = [];
  let sending = Promise.resolve();

  const pick = (files) => {
    chosen = [...files];
    ready.hidden = chosen.length === 0;
    named.hidden = chosen.length !== 1;
    const start = button(chosen.length === 1 ? "Upload" : `Upload ${chosen.length} recordings`, startUploads, { kind: "primary" });
    replace(
      ready,
      h("ul", {}, chosen.map((file) => h("li", {}, `${file.name}, ${bytes(file.size)}`))),
      named,
      as,
      h("div", { class: "actions" }, start, button("Clear", () => pick([]))),
    );
    describe();
    if (chosen.length) start.focus();
  };
  const startUploads = () => {
    const title = chosen.length === 1 ? name.value.trim() : "";
    for (const file of chosen) enqueue(file, title);
    name.value = input.value = "";
    pick([]);
  };
  // proposals: options from error messages that the user accepted for this file
  const enqueue = (file, title, proposals = [], place = h("div", {})) => {
    if (!place.isConnected) outcomes.prepend(place);
    replace(place, h("p", { class: "muted" }, `${file.name} is queued.`));
    sending = sending.then(() => send(file, title, proposals, place));
  };
  const send = async (file, title, proposals, place) => {
    const stop = new AbortController();
    const bar = progress(0, `Upload of ${file.name}`);
    const status = h("p", { role: "status" }, `Uploading ${file.name}…`);
    const stopping = h("div", { class: "actions" }, button("Cancel", () => stop.abort()));
    replace(place, status, bar, stopping);
    const sent = (share) => {
      if (share < 1) bar.value = share;
      else {
        bar.removeAttribute("value"); // the duration of the import is unknown
        status.textContent = `${file.name} is uploaded. Importing…`;
        stopping.remove(); // the service may have stored it already
      }
    };
    const values = proposals.reduce((all, each) => withOption(all, ...each), options.values());
    let dataset;
    try {
      dataset = await upload(file, { ...values, name: title }, sent, stop.signal);
    } catch (error) {
      if (stop.signal.aborted) {
        replace(place, h("p", { class: "muted" }, `Upload of ${file.name} cancelled.`));
        return;
      }
      const accept = (option, value) => enqueue(file, title, [...proposals, [option, value]], place);
      replace(place, uploadError(file.name, error, accept, () => enqueue(file, title, proposals, place)));
      if (signal.aborted) notice(`${file.name} could not be imported: ${error.message}`, "bad");
      return;
    }
    replace(place, uploadSummary(dataset));
    if (signal.aborted) notice(`${file.name} uploaded.`);
    else await Promise.resolve(onUploaded(dataset)).catch((error) => notice(error.message, "bad"));
  };

  input.addEventListener("change", () => pick(input.files));
  const over = (event) => {
    if (!event.dataTransfer?.types.includes("Files")) return;
    event.preventDefault();
    zone.style.borderColor = event.type === "dragover" ? "var(--accent)" : "";
    if (event.type === "drop") pick(event.dataTransfer.files);
  };
  for (const kind of ["dragover", "dragleave", "drop"]) window.addEventListener(kind, over, { signal });

  return { element: card("Upload a recording", zone, ready, outcomes, options.element), fillRobots: options.fillRobots };
}

function uploadSummary(dataset) {
  const { report } = dataset;
  const found = [countIfAny(report.warnings, "warning"), countIfAny(report.advice, "recommendation")].filter(Boolean);
  return h(
    "div",
    { class: "banner", role: "status", style: "border-color: var(--good); background: var(--good-bg); color: var(--good)" },
    h("p", {}, `✓ ${dataset.name}: ${counted(report.rows, "sample")} of ${counted(dataset.joint_names.length, "joint")}`, found.length ? `, ${found.join(" and ")}.` : "."),
    report.reading.length ? h("p", { class: "hint" }, report.reading.map(sentence).join(" ")) : null,
    h("div", { class: "actions" }, link("View report", `#/data/${dataset.id}`), link("Train on this recording", `#/train?datasets=${dataset.id}`)),
  );
}

function countIfAny(texts, what) {
  return texts.length ? counted(texts.length, what) : "";
}
