// The pieces that pages are made of.

import { ApiError } from "./api.js";
import { h, refresh } from "./dom.js";

let names = 0;

/** The page's heading with what can be done beside it. */
export function heading(text, ...actions) {
  return h("div", { class: "heading" }, h("h1", {}, text), actions.length ? h("div", { class: "actions" }, actions) : null);
}

/** A part of a page with a title of its own. */
export function card(title, ...children) {
  return h("section", { class: "card", "aria-label": title }, h("h2", {}, title), children);
}

/**
 * A table; columns: [{label, cell: row => node or text, numeric}]. It scrolls by itself where it is too wide.
 * key(row): what tells rows apart where the table is refreshed and rows come, go or move.
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
  // outside of what scrolls, so that it can be read whole on a phone
  return caption ? h("div", {}, h("p", { class: "caption", "aria-hidden": "true" }, caption), made) : made;
}

/** Pairs of a name and what belongs to it: [[name, node or text], …]. */
export function facts(pairs) {
  return h("dl", { class: "facts" }, pairs.map(([name, what]) => h("div", {}, h("dt", {}, name), h("dd", {}, what))));
}

/** An explanation that is there for who asks for it; first: what everybody is to see of it. */
export function explained(text, first = "") {
  return h("details", { class: "hint" }, h("summary", {}, first, "How to read it"), h("p", {}, text));
}

/** What a page shows where there is nothing yet, and what to do about it. */
export function empty(text, ...actions) {
  return h("div", { class: "empty" }, h("p", {}, text), actions.length ? h("div", { class: "actions" }, actions) : null);
}

/** An error in the service's own words, with field, value and what was expected where it says so. */
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
          { caption: "What was wrong" },
        )
      : null,
    retry ? h("div", { class: "actions" }, button("Try again", retry)) : null,
  );
}

/** A word about a state, told apart by its sign too. */
export function badge(state, kind = KINDS[state] ?? "plain") {
  return h("span", { class: `badge ${kind}` }, `${SIGNS[kind]} ${state}`);
}

/** Something is on its way. */
export function loading(what = "Loading") {
  return h("p", { class: "loading", role: "status" }, `${what}…`);
}

/** How much of something is done, 0 to 1. */
export function progress(fraction, label) {
  return h("progress", { max: "1", value: String(fraction), "aria-label": label }, `${Math.round(100 * fraction)} %`);
}

/** An input with its label and a hint. */
export function field(label, input, hint) {
  input.id ||= `field-${(names += 1)}`;
  const about = hint ? h("span", { class: "hint", id: `${input.id}-hint` }, hint) : null;
  if (about) input.setAttribute("aria-describedby", about.id);
  const named = h("label", { for: input.id }, label);
  if (input.type === "checkbox") return h("div", { class: "field check" }, input, named, about);
  return h("div", { class: "field" }, named, input, about);
}

/** A list to choose one of: [[value, label], …] or texts. */
export function select(options, chosen, onchange) {
  const made = h("select", { onchange: (event) => onchange?.(event.target.value) });
  return offer(made, options, chosen);
}

/** Bring the options of such a list up to date, and which one is chosen, while it stays where it is. */
export function offer(made, options, chosen) {
  const pairs = options.map((option) => (Array.isArray(option) ? option : [option, option]));
  refresh(made, pairs.map(([value, label]) => h("option", { value }, label)));
  if (made.value !== chosen && pairs.some(([value]) => value === chosen)) made.value = chosen;
  return made;
}

/** A button; while what it started runs, it cannot be pressed again. What goes wrong is shown as a notice. */
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

/** Ask before something that cannot be undone, or that robots notice; true where it is to be done. */
export function confirm(question, label = "Go on", kind = "danger") {
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

/** Say something in a corner of the page; kind: good, bad or plain. Bad news stays until it is closed. */
export function notice(text, kind = "good") {
  const made = h("div", { class: `notice ${kind}` }, h("span", {}, text), h("button", { type: "button", "aria-label": "Close", onclick: () => made.remove() }, "×"));
  document.getElementById("notices").append(made);
  if (kind !== "bad") setTimeout(() => made.remove(), 6000);
}

/** Tabs: [[name, label], …]; show(name) is called for the first, or `chosen`, and whenever another is chosen. */
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
      if (here) requestAnimationFrame(() => bring(list, tab));
    }
    show(name);
  }
  if (chosen !== undefined) choose(chosen);
  return list;
}

/** Scroll a row of tabs so that one of them is seen, and nothing else. */
function bring(list, tab) {
  const [all, one] = [list.getBoundingClientRect(), tab.getBoundingClientRect()];
  list.scrollLeft += Math.min(one.left - all.left, 0) + Math.max(one.right - all.right, 0);
}

/** Do something now and every so many seconds while the page is seen, one at a time, until the signal aborts. */
export async function every(seconds, work, signal) {
  while (!signal.aborted) {
    if (!document.hidden) await work();
    await new Promise((resolve) => {
      const timer = setTimeout(resolve, 1000 * seconds);
      signal.addEventListener("abort", () => (clearTimeout(timer), resolve()), { once: true });
    });
  }
}

const KINDS = {
  ok: "good", alive: "good", ready: "good", succeeded: "good", serving: "good", well: "good", learnt: "good",
  running: "busy", queued: "busy", reconnecting: "busy",
  warning: "warn", poorly: "warn", held: "warn", cancelled: "plain",
  failed: "bad", error: "bad", "not ready": "bad", "not determined": "bad",
};
const SIGNS = { good: "✓", busy: "◌", warn: "!", bad: "✕", plain: "·" };

function title(error) {
  if (!(error instanceof ApiError)) return "Something went wrong in this page.";
  const titles = { 0: "No answer.", 401: "A key is needed.", 403: "Not allowed.", 404: "Not there.", 507: "No room." };
  return titles[error.status] ?? "The service refused it.";
}

function text(value) {
  return typeof value === "string" ? value : JSON.stringify(value);
}
