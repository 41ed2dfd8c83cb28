// Uploading recordings: by a button or by dropping them on the page, one after the other.

import { lacking } from "../../abilities.js";
import { upload } from "../../api.js";
import { h, replace } from "../../dom.js";
import { bytes, counted } from "../../format.js";
import { button, card, field, link, notice, progress } from "../../ui.js";
import { inWords, uploadOptions, withOption } from "./options.js";
import { refusal } from "./refusal.js";

const ENDINGS = ".csv,.tsv,.txt,.npz,.parquet,.pq,.ndjson,.jsonl,.json,.db3,.bag,.mcap,.zip";

/** The card to upload with. onUploaded(dataset) is called for each. Returns {element, fillRobots(robots)}. */
export function uploader({ onUploaded, signal }) {
  const options = uploadOptions();
  const name = h("input", { type: "text", name: "name", maxlength: "200", autocomplete: "off" });
  const named = field("Name", name, "What people will call it; the file’s name if empty.");
  const input = h("input", { type: "file", multiple: true, accept: ENDINGS, "aria-label": "Recordings to upload", hidden: true });
  const choose = button("Choose files", () => input.click());
  const zone = h(
    "div",
    { class: "empty" },
    h("p", {}, "Drop recordings anywhere on this page, or choose them here."),
    h("div", { class: "actions" }, choose, input),
    h("p", { class: "hint" }, "CSV, Parquet, NPZ, JSON, rosbag1, rosbag2, MCAP, LeRobot (zip). At least times, positions and torques."),
    lacking("ingest"),
  );
  const ready = h("div", { hidden: true });
  const as = h("p", { class: "hint" });
  // options outlive an upload: who sends the next file shall see what it will be read as
  const say = () => {
    const values = options.values();
    as.textContent = Object.keys(values).length ? `It is read as set below: ${inWords(values)}.` : "The service finds out what it holds. Set the options below to tell it.";
  };
  options.element.addEventListener("change", say);
  const outcomes = h("div", {});
  let chosen = [];
  let sending = Promise.resolve();

  const pick = (files) => {
    chosen = [...files];
    ready.hidden = chosen.length === 0;
    named.hidden = chosen.length !== 1;
    const start = button(chosen.length === 1 ? "Upload" : `Upload ${chosen.length} recordings`, go, { kind: "primary" });
    replace(
      ready,
      h("ul", {}, chosen.map((file) => h("li", {}, `${file.name}, ${bytes(file.size)}`))),
      named,
      as,
      h("div", { class: "actions" }, start, button("Clear", () => pick([]))),
    );
    say();
    if (chosen.length) start.focus();
  };
  const go = () => {
    const title = chosen.length === 1 ? name.value.trim() : "";
    for (const file of chosen) enqueue(file, title);
    name.value = input.value = "";
    pick([]);
  };
  // proposals: options that the user took from the service's refusals of this file
  const enqueue = (file, title, proposals = [], place = h("div", {})) => {
    if (!place.isConnected) outcomes.prepend(place);
    replace(place, h("p", { class: "muted" }, `${file.name} waits for the upload before it.`));
    sending = sending.then(() => send(file, title, proposals, place));
  };
  const send = async (file, title, proposals, place) => {
    const stop = new AbortController();
    const bar = progress(0, `Upload of ${file.name}`);
    const said = h("p", { role: "status" }, `Sending ${file.name}…`);
    const stopping = h("div", { class: "actions" }, button("Stop", () => stop.abort()));
    replace(place, said, bar, stopping);
    const sent = (share) => {
      if (share < 1) bar.value = share;
      else {
        bar.removeAttribute("value"); // how long reading takes, nobody knows
        said.textContent = `${file.name} is sent; the service reads, checks and prepares it…`;
        stopping.remove(); // from here on the service may have stored it
      }
    };
    const values = proposals.reduce((all, each) => withOption(all, ...each), options.values());
    let dataset;
    try {
      dataset = await upload(file, { ...values, name: title }, sent, stop.signal);
    } catch (error) {
      if (stop.signal.aborted) {
        replace(place, h("p", { class: "muted" }, `${file.name} was stopped before all of it was sent.`));
        return;
      }
      const accept = (option, value) => enqueue(file, title, [...proposals, [option, value]], place);
      replace(place, refusal(file.name, error, accept, () => enqueue(file, title, proposals, place)));
      if (signal.aborted) notice(`${file.name} was not taken: ${error.message}`, "bad");
      return;
    }
    replace(place, taken(dataset));
    if (signal.aborted) notice(`${file.name} is uploaded.`);
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

function taken(dataset) {
  const { report } = dataset;
  const found = [some(report.warnings, "warning"), some(report.advice, "hint")].filter(Boolean);
  return h(
    "div",
    { class: "banner", role: "status", style: "border-color: var(--good); background: var(--good-bg); color: var(--good)" },
    h("p", {}, `✓ ${dataset.name}: ${counted(report.rows, "sample")} of ${counted(dataset.joint_names.length, "joint")}`, found.length ? `, ${found.join(" and ")}.` : "."),
    report.reading.length ? h("p", { class: "hint" }, report.reading.join(". "), ".") : null,
    h("div", { class: "actions" }, link("Read its report", `#/data/${dataset.id}`), link("Train on it", `#/train?datasets=${dataset.id}`)),
  );
}

function some(texts, what) {
  return texts.length ? counted(texts.length, what) : "";
}
