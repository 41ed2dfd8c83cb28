// Building blocks of the pages.

import { ApiError } from "./api.js";
import { h, refresh } from "./dom.js";

let names = 0;

/** The page's heading with its actions. */
export function heading(text, ...actions) {
  return h("div", { class: "heading" }, h("h1", {}, text), actions.length ? h("div", { class: "actions" }, actions) : null);
}

/** A section of a page with a title. */
export function card(title, ...children) {
  return h("section", { class: "card", "aria-label": title }, h("h2", {}, title), children);
}

/**
 * A table that scrolls horizontally if it is too wide. columns: [{label, cell: row => node or text, numeric}];
 * key(row): identity of a row, needed if rows change.
 */
export function table(columns, rows, { caption, key } = {}) {
  const kind = (column) => (column.numeric ? { class: "numeric" } : {});
  const name = caption ?? columns.map((column) => column.label).join(", ");
  const made = h(
    "div",
    { class: "scroll", tabindex: "0", role: "region", "aria-label": name },
    h(
      "table",
      { "aria-label": name },
      h("thead", {}, h("tr", {}, columns.map((column) => h("th", { scope: "col", ...kind(column) }, column.label)))),
      h("tbody", {}, rows.map((row) => h("tr", key ? { "data-key": key(row) } : {}, columns.map((column) => h("td", kind(column), column.cell(row)))))),
    ),
  );
  // outside the scrolling region, so that a phone shows all of it
  return caption ? h("div", {}, h("p", { class: "caption", "aria-hidden": "true" }, caption), made) : made;
}

/** A list of names and values: [[name, node or text], …]. */
export function facts(pairs) {
  return h("dl", { class: "facts" }, pairs.map(([name, what]) => h("div", {}, h("dt", {}, name), h("dd", {}, what))));
}

/** An explanation that the reader can open; first: text that is always visible. */
export function explanation(text, first = "") {
  return h("details", { class: "hint" }, h("summary", {}, first, "How to read this"), h("p", {}, text));
}

/** The empty state of a page: a text and actions. */
export function empty(text, ...actions) {
  return h("div", { class: "empty" }, h("p", {}, text), actions.length ? h("div", { class: "actions" }, actions) : null);
}

/** An error with the service's message and its table of fields, values and expectations. */
export function errorBox(error, retry) {
  const detail = error instanceof ApiError ? error.detail : [];
  return h(
    "div",
    { class: "error", role: "alert" },
    h("p", {}, h("strong", {}, title(error)), " ", error.message),
    detail?.length
      ? table(
          [
            { label: "field", cell: (item) => h("code", {}, item.field) },
            { label: "value", cell: (item) => h("code", {}, text(item.value)) },
            { label: "expected", cell: (item) => text(item.expected) },
          ],
          detail,
          { caption: "Details" },
        )
      : null,
    retry ? h("div", { class: "actions" }, button("Retry", retry)) : null,
  );
}

/** A badge for a state, with a symbol so that colour is not the only cue. */
export function badge(state, kind = KINDS[state] ?? "plain") {
  return h("span", { class: `badge ${kind}` }, `${SIGNS[kind]} ${state}`);
}

/** A loading indicator. */
export function loading(what = "Loading") {
  return h("p", { class: "loading", role: "status" }, `${what}…`);
}

/** A progress bar; fraction: 0 to 1. */
export function progress(fraction, label) {
  return h("progress", { max: "1", value: String(fraction), "aria-label": label }, `${Math.round(100 * fraction)} %`);
}

/** An input with its label and hint. */
export function field(label, input, hint) {
  input.id ||= `field-${(names += 1)}`;
  const about = hint ? h("span", { class: "hint", id: `${input.id}-hint` }, hint) : null;
  if (about) input.setAttribute("aria-describedby", about.id);
  const named = h("label", { for: input.id }, label);
  if (input.type === "checkbox") return h("div", { class: "field check" }, input, named, about);
  return h("div", { class: "field" }, named, input, about);
}

/** A select of [[value, label], …] or of texts. */
export function select(options, chosen, onchange) {
  const made = h("select", { onchange: (event) => onchange?.(event.target.value) });
  return updateSelect(made, options, chosen);
}

/** Update the options and the value of a select in place. */
export function updateSelect(made, options, chosen) {
  const pairs = options.map((option) => (Array.isArray(option) ? option : [option, option]));
  refresh(made, pairs.map(([value, label]) => h("option", { value }, label)));
  if (made.value !== chosen && pairs.some(([value]) => value === chosen)) made.value = chosen;
  return made;
}

/** A button that is disabled while its action runs. An error is shown as a notice. */
export function button(label, onclick, { kind = "" } = {}) {
  const made = h("button", { type: "button", class: kind }, label);
  made.addEventListener("click", async () => {
    made.disabled = true;
    try {
      await onclick();
    } catch (error) {
      if (error.name !== "AbortError") notice(error.message, "bad");
    } finally {
      made.disabled = false;
    }
  });
  return made;
}

/** A link to a page of the dashboard. */
export function link(label, hash, kind = "") {
  return h("a", { href: hash, class: kind }, label);
}

/** Ask for confirmation before an action that cannot be undone or that affects robots; return whether to proceed. */
export function confirm(question, label = "Continue", kind = "danger") {
  return new Promise((resolve) => {
    const box = h(
      "dialog",
      { "aria-label": label },
      h(
        "form",
        { method: "dialog" },
        h("p", {}, question),
        h(
          "div",
          { class: "actions" },
          h("button", { class: kind, value: "yes" }, label),
          h("button", { value: "no", autofocus: true }, "Cancel"),
        ),
      ),
    );
    box.addEventListener("close", () => {
      box.remove();
      resolve(box.returnValue === "yes");
    });
    document.body.append(box);
    box.showModal();
  });
}

/** Show a notice in a corner of the page; kind: good, bad or plain. A bad one stays until it is closed. */
export function notice(text, kind = "good") {
  const made = h("div", { class: `notice ${kind}` }, h("span", {}, text), h("button", { type: "button", "aria-label": "Close", onclick: () => made.remove() }, "×"));
  document.getElementById("notices").append(made);
  if (kind !== "bad") setTimeout(() => made.remove(), 6000);
}

/** Tabs [[name, label], …]. show(name) is called for `chosen` at once, and for each tab that is selected later. */
export function tabs(options, show, chosen = options[0]?.[0]) {
  const made = options.map(([name, label]) =>
    h("button", { type: "button", role: "tab", onclick: () => choose(name), dataset: { name } }, label),
  );
  const list = h("div", { class: "tabs", role: "tablist" }, made);
  list.addEventListener("keydown", (event) => {
    const at = made.indexOf(document.activeElement);
    const to = { ArrowRight: at + 1, ArrowLeft: at - 1, Home: 0, End: -1 }[event.key];
    if (to === undefined) return;
    event.preventDefault();
    const next = made[(to + made.length) % made.length];
    next.focus();
    next.click();
  });
  function choose(name) {
    for (const tab of made) {
      const here = tab.dataset.name === name;
      tab.setAttribute("aria-selected", String(here));
      tab.tabIndex = here ? 0 : -1;
      if (here) requestAnimationFrame(() => scrollToTab(list, tab));
    }
    show(name);
  }
  if (chosen !== undefined) choose(chosen);
  return list;
}

/** Scroll a tab into view without scrolling the page. */
function scrollToTab(list, tab) {
  const [all, one] = [list.getBoundingClientRect(), tab.getBoundingClientRect()];
  list.scrollLeft += Math.min(one.left - all.left, 0) + Math.max(one.right - all.right, 0);
}

/** Run `work` now and again after each pause of `seconds`, while the page is visible, until the signal aborts. */
export async function repeat(seconds, work, signal) {
  while (!signal.aborted) {
    if (!document.hidden) await work();
    await new Promise((resolve) => {
      const timer = setTimeout(resolve, 1000 * seconds);
      signal.addEventListener("abort", () => (clearTimeout(timer), resolve()), { once: true });
    });
  }
}

const KINDS = {
  ok: "good", alive: "good", ready: "good", succeeded: "good", serving: "good", learnt: "good",
  running: "busy", queued: "busy", reconnecting: "busy",
  warning: "warn", paused: "warn", cancelled: "plain",
  failed: "bad", error: "bad", "not ready": "bad",
};
const SIGNS = { good: "✓", busy: "◌", warn: "!", bad: "✕", plain: "·" };

function title(error) {
  if (!(error instanceof ApiError)) return "This page failed.";
  const titles = { 0: "No connection.", 401: "API key required.", 403: "Not allowed.", 404: "Not found.", 507: "Disk full." };
  return titles[error.status] ?? "Request rejected.";
}

function text(value) {
  return typeof value === "string" ? value : JSON.stringify(value);
}
