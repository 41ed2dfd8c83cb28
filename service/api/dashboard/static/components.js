// Building blocks of the pages, as Preact components.

import { ApiError } from "./api.js";
import { counted } from "./format.js";
import { html, render, useCallback, useEffect, useMemo, useRef, useState } from "./preact.js";
import { notice } from "./dialogs.js";

/** Make the `render` function of a page from its component. It receives `{...params, query, signal, title}`. */
export function page(Component) {
  return (view, params, { signal, title }) => {
    render(html`<${Component} ...${params} signal=${signal} title=${title} />`, view);
    signal.addEventListener("abort", () => render(null, view));
  };
}

/**
 * Read a value with `read(signal)`, again whenever `inputs` change, and every `period` seconds while the page is visible.
 * Returns {value, error, at, reload}: after an error, the last value and its time `at` stay.
 */
export function useRead(read, inputs, period = null) {
  const [state, setState] = useState({ value: null, error: null, at: null });
  const [turn, setTurn] = useState(0);
  useEffect(() => {
    const stop = new AbortController();
    let timer = null;
    const look = async () => {
      if (!period || !document.hidden) {
        try {
          const value = await read(stop.signal);
          if (!stop.signal.aborted) setState({ value, error: null, at: Date.now() });
        } catch (error) {
          if (stop.signal.aborted || error.name === "AbortError") return;
          if (error.name !== "ApiError") console.error(error);
          setState((last) => ({ ...last, error }));
          if (error.status === 401 || error.status === 403) return; // the dialog for the key would open again and again
        }
      }
      if (period && !stop.signal.aborted) timer = setTimeout(look, 1000 * period);
    };
    look();
    return () => {
      stop.abort();
      clearTimeout(timer);
    };
  }, [...inputs, turn]);
  return { ...state, reload: useCallback(() => setTurn((last) => last + 1), []) };
}

/** Children once a value is read; until then a note, after an error its message. Takes the result of `useRead`. */
export function Await({ reading: { value, error, reload }, what, children }) {
  if (value !== null) return html`${error && html`<${ErrorBox} error=${error} retry=${reload} />`}${children(value)}`;
  return error ? html`<${ErrorBox} error=${error} retry=${reload} />` : html`<${Loading} what=${what} />`;
}

/** The page's heading; children are its actions. */
export function Heading({ text, children }) {
  return html`<div class="heading"><h1>${text}</h1>${children && html`<div class="actions">${children}</div>`}</div>`;
}

/** A section of a page with a title. term: the anchor of its definition in the glossary. */
export function Card({ title, term, kind = "", children }) {
  return html`<section class=${`card ${kind}`.trim()} aria-label=${title}><h2>${term ? html`<${Term} of=${term}>${title}<//>` : title}</h2>${children}</section>`;
}

/** A word with a link to its definition. of: the anchor in the glossary of the guide. */
export function Term({ of, children }) {
  return html`<a class="term" href=${`/guide/glossary/#${of}`}>${children}</a>`;
}

/** A badge for a state, with a symbol so that colour is not the only cue. */
export function Badge({ state, kind = KINDS[state] ?? "plain", title }) {
  return html`<span class=${`badge ${kind}`} title=${title}>${SIGNS[kind]} ${state}</span>`;
}

/** A loading indicator. */
export function Loading({ what = "Loading" }) {
  return html`<p class="loading" role="status">${what}…</p>`;
}

/** The empty state of a page: a text; children are actions. */
export function Empty({ text, children }) {
  return html`<div class="empty"><p>${text}</p>${children && html`<div class="actions">${children}</div>`}</div>`;
}

/** A link to a page of the dashboard. */
export function Link({ to, kind = "", label, children }) {
  return html`<a href=${to} class=${kind} aria-label=${label}>${children}</a>`;
}

/** A button that is disabled while its action runs. An error is shown as a notice. */
export function Button({ onclick, kind = "", label, disabled = false, children }) {
  const [busy, setBusy] = useState(false);
  const press = async () => {
    setBusy(true);
    try {
      await onclick();
    } catch (error) {
      if (error.name !== "AbortError") notice(error.message, "bad");
    } finally {
      setBusy(false);
    }
  };
  return html`<button type="button" class=${kind} aria-label=${label} disabled=${busy || disabled} onClick=${press}>${children}</button>`;
}

/** An input with its label and hint. `input(attributes)` returns the input, which must take the attributes. */
export function Field({ label, hint, kind = "", input }) {
  const id = useId();
  const attributes = { id, ...(hint ? { "aria-describedby": `${id}-hint` } : {}) };
  const about = hint && html`<span class="hint" id=${`${id}-hint`}>${hint}</span>`;
  return html`<div class=${`field ${kind}`.trim()}><label for=${id}>${label}</label>${input(attributes)}${about}</div>`;
}

/** A select with a label. options: [[value, label, disabled reason], …] or texts. */
export function Choice({ label, hint, options, value, onchange }) {
  const pairs = options.map((option) => (Array.isArray(option) ? option : [option, option]));
  const title = pairs.find(([each]) => each === value)?.[1]; // a narrow select cuts it
  const made = ([each, text, why]) => html`<option value=${each} selected=${each === value} disabled=${Boolean(why)}>${why ? `${text} (${why})` : text}</option>`;
  return html`<${Field} label=${label} hint=${hint} input=${(attributes) => html`<select ...${attributes} title=${title} value=${value} onChange=${(event) => onchange(event.target.value)}>${pairs.map(made)}</select>`} />`;
}

/** A progress bar; fraction: 0 to 1. */
export function Progress({ fraction, label }) {
  return html`<progress max="1" value=${fraction} aria-label=${label}>${Math.round(100 * fraction)} %</progress>`;
}

/** A list of names and values: [[name, content], …]. */
export function Facts({ pairs }) {
  return html`<dl class="facts">${pairs.map(([name, what]) => html`<div><dt>${name}</dt><dd>${what}</dd></div>`)}</dl>`;
}

/** An error with the service's message and its table of fields, values and expectations. */
export function ErrorBox({ error, retry }) {
  const detail = error instanceof ApiError ? error.detail : [];
  const columns = [
    { label: "field", cell: (item) => html`<code>${item.field}</code>` },
    { label: "value", cell: (item) => html`<code>${asText(item.value)}</code>` },
    { label: "expected", cell: (item) => asText(item.expected) },
  ];
  return html`<div class="error" role="alert">
    <p><strong>${errorTitle(error)}</strong> ${error.message}</p>
    ${detail?.length > 0 && html`<${Table} columns=${columns} rows=${detail} caption="Details" />`}
    ${retry && html`<div class="actions"><${Button} onclick=${retry}>Retry<//></div>`}
  </div>`;
}

/** A table that scrolls horizontally if it is too wide. columns: [{label, term, cell: row => content, numeric}], with the `of` of a `Term`; identity(row, index): its key. */
export function Table({ columns, rows, caption, identity = (_row, index) => index }) {
  const kind = (column) => (column.numeric ? "numeric" : undefined);
  const name = caption ?? columns.map((column) => column.label).join(", ");
  return html`<div>
    ${caption && html`<p class="caption" aria-hidden="true">${caption}</p>`}
    <div class="scroll" tabindex="0" role="region" aria-label=${name}>
      <table aria-label=${name}>
        <thead><tr>${columns.map((column) => html`<th scope="col" class=${kind(column)}>${column.term ? html`<${Term} of=${column.term}>${column.label}<//>` : column.label}</th>`)}</tr></thead>
        <tbody>${rows.map((row, index) => html`<tr key=${identity(row, index)} data-key=${identity(row, index)}>${columns.map((column) => html`<td class=${kind(column)}>${column.cell(row)}</td>`)}</tr>`)}</tbody>
      </table>
    </div>
  </div>`;
}

/**
 * A table that can be filtered and sorted. columns as of `Table`, with value: row => sort key, and first: "descending";
 * words: row => searched text; what: [singular, plural] of a row; minRows: number of rows from which the filter is shown.
 */
export function Listing({ columns, rows, caption, words, identity, what = ["row", "rows"], minRows = 2 }) {
  const [text, setText] = useState(""), [sort, setSort] = useState(null);
  const shown = useMemo(() => sortRows(columns, sort, filterRows(rows, words, text)), [columns, rows, sort, text]);
  const head = (column) => {
    const kind = column.numeric ? "numeric" : undefined;
    if (!column.value) return html`<th scope="col" class=${kind}>${column.label}</th>`;
    const how = sort?.[0] === column.label ? sort[1] : "none";
    return html`<th scope="col" class=${kind} aria-sort=${how}><button type="button" class="sort" onClick=${() => setSort(nextSort(sort, column))}>${column.label}</button></th>`;
  };
  const row = (each) => html`<tr key=${identity(each)} data-key=${identity(each)}>${columns.map((column) => html`<td class=${column.numeric ? "numeric" : undefined}>${column.cell(each)}</td>`)}</tr>`;
  return html`<div class="listing">
    <div class="filter" hidden=${rows.length < minRows}>
      <input type="search" placeholder="Filter" aria-label=${`Filter ${what[1]}`} autocomplete="off" spellcheck=${false} value=${text} onInput=${(event) => setText(event.target.value)} />
      <p class="hint" role="status">${text.trim() ? `${shown.length} of ` : ""}${counted(rows.length, ...what)}</p>
    </div>
    <div class="scroll" tabindex="0" role="region" aria-label=${caption}>
      <table aria-label=${caption}>
        <thead><tr>${columns.map(head)}</tr></thead>
        <tbody>${shown.length ? shown.map(row) : html`<tr><td colspan=${columns.length} class="muted">No ${what[1]} match.</td></tr>`}</tbody>
      </table>
    </div>
  </div>`;
}

/** Tabs [[name, label], …]; children are the panel of the chosen one. */
export function Tabs({ label, options, chosen, onchoose, children }) {
  const list = useRef(null);
  const move = (event) => {
    const at = options.findIndex(([name]) => name === chosen);
    const to = { ArrowRight: at + 1, ArrowLeft: at - 1, Home: 0, End: options.length - 1 }[event.key];
    if (to === undefined) return;
    event.preventDefault();
    const index = (to + options.length) % options.length;
    onchoose(options[index][0]);
    list.current.children[index].focus();
  };
  useEffect(() => scrollToTab(list.current), [chosen]);
  const tab = ([name, text]) => html`<button type="button" role="tab" data-name=${name} aria-selected=${String(name === chosen)} tabindex=${name === chosen ? 0 : -1} onClick=${() => onchoose(name)}>${text}</button>`;
  const title = options.find(([name]) => name === chosen)?.[1];
  return html`<div class="tabs" role="tablist" aria-label=${label} ref=${list} onKeyDown=${move}>${options.map(tab)}</div>
    <div role="tabpanel" aria-label=${title} data-tab=${chosen}>${children}</div>`;
}

/** A place for code that draws by itself, such as a plot: `draw(element, signal)` runs again whenever `inputs` change. */
export function Drawn({ draw, inputs, kind = "plot" }) {
  const place = useRef(null), [error, setError] = useState(null);
  useEffect(() => {
    const stop = new AbortController();
    Promise.resolve(draw(place.current, stop.signal)).then(
      () => setError(null),
      (failure) => {
        if (stop.signal.aborted || failure.name === "AbortError") return;
        if (failure.name !== "ApiError") console.error(failure);
        setError(failure);
      },
    );
    return () => stop.abort();
  }, inputs);
  return html`${error && html`<${ErrorBox} error=${error} />`}<div class=${kind} ref=${place}></div>`;
}

let names = 0;

function useId() {
  return useMemo(() => `input-${(names += 1)}`, []);
}

/** Scroll the selected tab into view without scrolling the page. */
function scrollToTab(list) {
  const one = list.querySelector('[aria-selected="true"]')?.getBoundingClientRect(), all = list.getBoundingClientRect();
  if (one) list.scrollLeft += Math.min(one.left - all.left, 0) + Math.max(one.right - all.right, 0);
}

/** Return the next order of a column: first direction, other direction, unsorted. */
function nextSort(sort, { label, first = "ascending" }) {
  if (sort?.[0] !== label) return [label, first];
  return sort[1] === first ? [label, first === "ascending" ? "descending" : "ascending"] : null;
}

function sortRows(columns, sort, rows) {
  const column = columns.find((each) => each.label === sort?.[0]);
  if (!column) return rows;
  const sign = sort[1] === "descending" ? -1 : 1;
  const missing = (value) => value === null || value === undefined || Number.isNaN(value);
  return rows.map((row) => [row, column.value(row)]).sort(([, a], [, b]) => {
    if (missing(a) || missing(b)) return Number(missing(a)) - Number(missing(b)); // unknown values are last in both directions
    return sign * (typeof a === "number" ? a - b : String(a).localeCompare(String(b), "en", { numeric: true }));
  }).map(([row]) => row);
}

function filterRows(rows, words, text) {
  const wanted = text.toLowerCase().split(/\s+/).filter(Boolean);
  return rows.filter((row) => wanted.every((each) => words(row).toLowerCase().includes(each)));
}

const KINDS = {
  ok: "good", alive: "good", ready: "good", succeeded: "good", serving: "good", learnt: "good",
  running: "busy", queued: "busy", reconnecting: "busy",
  warning: "warn", paused: "warn", cancelled: "plain",
  failed: "bad", error: "bad", "not ready": "bad",
};
const SIGNS = { good: "✓", busy: "◌", warn: "!", bad: "✕", plain: "·" };

function errorTitle(error) {
  if (!(error instanceof ApiError)) return "This page failed.";
  const titles = { 0: "No connection.", 401: "API key required.", 403: "Not allowed.", 404: "Not found.", 507: "Disk full." };
  return titles[error.status] ?? "Request rejected.";
}

function asText(value) {
  return typeof value === "string" ? value : JSON.stringify(value);
}
