// Upload of recordings, one after the other, chosen by a button or dropped on the page.

import { upload } from "../../api.js";
import { Button, Card, Field, Link, Progress, useRead } from "../../components.js";
import { MissingExtra, useMissing } from "../../extras.js";
import { bytes, counted, sentence } from "../../format.js";
import { html, useEffect, useRef, useState } from "../../preact.js";
import { notice } from "../../dialogs.js";
import { describeOptions } from "./findings.js";
import { ImportOptions, queryOf, withOption } from "./options.js";
import { readRobots } from "./robot_choice.js";
import { UploadError } from "./upload_error.js";

const EXTENSIONS = ".csv,.tsv,.txt,.npz,.parquet,.pq,.ndjson,.jsonl,.json,.db3,.bag,.mcap,.zip,.feather,.arrow,.h5,.hdf5,.mat,.npy,.xlsx,.yaml,.yml,.gz,.zst";

/** The upload card. onuploaded(dataset) is called after each upload; signal: of the page. */
export function Uploader({ onuploaded, signal }) {
  const [options, setOptions] = useState({});
  const [files, setFiles] = useState([]), [name, setName] = useState("");
  const { outcomes, add } = useUploads(queryOf(options), onuploaded, signal);
  const robots = useRead(readRobots, []);
  const start = () => {
    for (const file of files) add(file, files.length === 1 ? name.trim() : "");
    setName("");
    setFiles([]);
  };
  return html`<${Card} title="Upload a recording">
    <details><summary>Import options: robot, units, columns, joints, effort, preparation</summary><${ImportOptions} value=${options} onchange=${setOptions} robots=${robots} /></details>
    <${Zone} onpick=${setFiles} />
    ${files.length > 0 && html`<${Ready} files=${files} name=${name} onname=${setName} query=${queryOf(options)} start=${start} clear=${() => setFiles([])} />`}
    ${outcomes.map((each) => html`<${Outcome} key=${each.key} ...${each} />`)}
  <//>`;
}

/** Where files are dropped or chosen. The whole page takes them. */
function Zone({ onpick }) {
  const input = useRef(null);
  const [over, setOver] = useState(false);
  const missing = useMissing("ingest");
  useEffect(() => {
    const stop = new AbortController();
    const dragged = (event) => {
      if (!event.dataTransfer?.types.includes("Files")) return;
      event.preventDefault();
      setOver(event.type === "dragover");
      if (event.type === "drop") onpick([...event.dataTransfer.files]);
    };
    for (const kind of ["dragover", "dragleave", "drop"]) window.addEventListener(kind, dragged, { signal: stop.signal });
    return () => stop.abort();
  }, []);
  const pick = (event) => {
    onpick([...event.target.files]);
    event.target.value = "";
  };
  return html`<div class=${over ? "empty over" : "empty"}>
    <p>Drop recordings anywhere on this page, or choose files.</p>
    <div class="actions"><${Button} onclick=${() => input.current.click()}>Choose files<//>
      <input type="file" multiple accept=${EXTENSIONS} aria-label="Recordings to upload" hidden ref=${input} onChange=${pick} /></div>
    <p class="hint">CSV, Excel, Parquet, HDF5, MATLAB, NumPy, JSON, rosbag1, rosbag2, MCAP, LeRobot (zip), also compressed. Required columns: time, position and torque.</p>
    <${MissingExtra} missing=${missing} />
  </div>`;
}

/** The chosen files, and how they will be read. */
function Ready({ files, name, onname, query, start, clear }) {
  const actions = useRef(null);
  useEffect(() => actions.current.querySelector("button").focus(), [files]);
  return html`<div>
    <ul>${files.map((file) => html`<li key=${file.name}>${file.name}, ${bytes(file.size)}</li>`)}</ul>
    ${files.length === 1 && html`<${Field} label="Name" hint="Default: the name of the file."
      input=${(attributes) => html`<input ...${attributes} type="text" name="name" maxlength="200" autocomplete="off" value=${name} onInput=${(event) => onname(event.target.value)} />`} />`}
    <p class="hint">${Object.keys(query).length ? `Import options: ${describeOptions(query)}.` : "The contents are detected automatically. To override this, set the import options above."}</p>
    <div class="actions" ref=${actions}><${Button} kind="primary" onclick=${start}>${files.length === 1 ? "Upload" : `Upload ${files.length} recordings`}<//><${Button} onclick=${clear}>Clear<//></div>
  </div>`;
}

/** Send files one after the other. Returns {outcomes, add(file, title)}; outcomes: newest first. */
function useUploads(query, onuploaded, signal) {
  const [outcomes, setOutcomes] = useState([]);
  const latest = useRef(query), sending = useRef(Promise.resolve()), count = useRef(0);
  latest.current = query;
  const show = (key, changed) => setOutcomes((all) => all.map((each) => (each.key === key ? { key, file: each.file, ...changed } : each)));
  // proposals: options from error messages that the user accepted for this file
  const send = async (key, file, title, proposals) => {
    const stop = new AbortController();
    const again = (more) => enqueue(key, file, title, [...proposals, ...more]);
    show(key, { state: "sending", share: 0, cancel: () => stop.abort() });
    const sent = (share) => show(key, share < 1 ? { state: "sending", share, cancel: () => stop.abort() } : { state: "importing" });
    try {
      const values = proposals.reduce((all, each) => withOption(all, ...each), latest.current);
      const dataset = await upload(file, { ...values, name: title }, sent, stop.signal);
      show(key, { state: "done", dataset });
      if (signal.aborted) notice(`${file.name} uploaded.`);
      else onuploaded(dataset);
    } catch (error) {
      if (stop.signal.aborted) return show(key, { state: "cancelled" });
      show(key, { state: "failed", error, accept: (option, value) => again([[option, value]]), again: () => again([]) });
      if (signal.aborted) notice(`${file.name} could not be imported: ${error.message}`, "bad");
    }
  };
  const enqueue = (key, file, title, proposals) => {
    show(key, { state: "queued" });
    sending.current = sending.current.then(() => send(key, file, title, proposals));
  };
  const add = (file, title) => {
    const key = (count.current += 1);
    setOutcomes((all) => [{ key, file, state: "queued" }, ...all]);
    enqueue(key, file, title, []);
  };
  return { outcomes, add };
}

function Outcome({ file, state, share, cancel, dataset, error, accept, again }) {
  if (state === "queued") return html`<p class="muted">${file.name} is queued.</p>`;
  if (state === "cancelled") return html`<p class="muted">Upload of ${file.name} cancelled.</p>`;
  if (state === "failed") return html`<${UploadError} name=${file.name} error=${error} accept=${accept} again=${again} />`;
  if (state === "done") return html`<${Uploaded} dataset=${dataset} />`;
  // the duration of the import is unknown, and it cannot be cancelled: the service may have stored the file already
  if (state === "importing") return html`<div><p role="status">${file.name} is uploaded. Importing…</p><progress aria-label=${`Import of ${file.name}`}></progress></div>`;
  return html`<div><p role="status">Uploading ${file.name}…</p><${Progress} fraction=${share} label=${`Upload of ${file.name}`} /><div class="actions"><${Button} onclick=${cancel}>Cancel<//></div></div>`;
}

function Uploaded({ dataset }) {
  const { report } = dataset;
  const found = [countIfAny(report.warnings, "warning"), countIfAny(report.advice, "recommendation")].filter(Boolean);
  return html`<div class="banner uploaded" role="status">
    <p>✓ ${dataset.name}: ${counted(report.rows, "sample")} of ${counted(dataset.joint_names.length, "joint")}${found.length ? `, ${found.join(" and ")}.` : "."}</p>
    ${report.reading.length > 0 && html`<p class="hint">${report.reading.map(sentence).join(" ")}</p>`}
    <div class="actions"><${Link} to=${`#/data/${dataset.id}`}>View report<//><${Link} to=${`#/train?datasets=${dataset.id}`}>Train on this recording<//></div>
  </div>`;
}

function countIfAny(texts, what) {
  return texts.length ? counted(texts.length, what) : "";
}
