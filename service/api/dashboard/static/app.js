// Router: shows the page that the part of the address after # names.

import { Empty, ErrorBox, Link, Loading } from "./components.js";
import { forgetKey, key } from "./keys.js";
import { html, render } from "./preact.js";

const ROUTES = [
  [/^\/?$/, "overview"],
  [/^\/data$/, "datasets"],
  [/^\/data\/(?<id>[^/]+)$/, "dataset"],
  [/^\/jobs$/, "jobs"],
  [/^\/jobs\/(?<id>[^/]+)$/, "job"],
  [/^\/train$/, "train"],
  [/^\/models$/, "models"],
  [/^\/models\/(?<name>[^/]+)$/, "model"],
  [/^\/live(?:\/(?<name>[^/]+))?$/, "live"],
];
const main = document.getElementById("main");
let leave = new AbortController();

async function show() {
  leave.abort();
  leave = new AbortController();
  const { signal } = leave;
  const [where, query = ""] = location.hash.slice(1).split("?");
  const [page, params] = findRoute(where);
  markSection(where);
  setTitle("");
  if (page === null) {
    put(html`<${Empty} text=${`Page ${where} does not exist.`}><${Link} to="#/">Overview<//><//>`);
    return;
  }
  put(html`<${Loading} />`);
  try {
    const module = await import(`./pages/${page}.js`);
    if (signal.aborted) return;
    await module.render(put(null), { ...params, query: new URLSearchParams(query) }, { signal, title: setTitle });
  } catch (error) {
    if (signal.aborted || error.name === "AbortError") return;
    if (!error.status && error.name !== "ApiError") console.error(error);
    put(html`<${ErrorBox} error=${error} retry=${show} />`);
  }
}

/** Show content in place of the page; return the element that contains it. */
function put(content) {
  const place = document.createElement("div");
  main.replaceChildren(place);
  render(content, place);
  return place;
}

function findRoute(where) {
  for (const [pattern, page] of ROUTES) {
    const found = pattern.exec(where);
    if (!found) continue;
    const params = Object.entries(found.groups ?? {}).map(([name, value]) => [name, value && decodeURIComponent(value)]);
    return [page, Object.fromEntries(params)];
  }
  return [null, {}];
}

function setTitle(text) {
  document.title = text ? `${text} · LIPServe` : "LIPServe";
}

function markSection(where) {
  const section = where.split("/")[1] ?? "";
  const home = section === "train" ? "jobs" : section;
  for (const each of document.querySelectorAll("#nav a")) {
    const here = each.getAttribute("href") === `#/${home}`;
    if (here) each.setAttribute("aria-current", "page");
    else each.removeAttribute("aria-current");
  }
}

function themeButton() {
  const themes = ["auto", "light", "dark"];
  const made = document.getElementById("theme");
  const update = () => {
    made.textContent = `Theme: ${document.documentElement.dataset.theme}`;
  };
  made.addEventListener("click", () => {
    const root = document.documentElement;
    root.dataset.theme = themes[(themes.indexOf(root.dataset.theme) + 1) % themes.length];
    localStorage.setItem("lipserve-theme", root.dataset.theme);
    update();
    document.dispatchEvent(new Event("themechange"));
  });
  update();
}

function keyButton() {
  const made = document.getElementById("key");
  const update = () => {
    made.hidden = !key();
    made.textContent = "Forget key";
  };
  made.addEventListener("click", () => {
    forgetKey();
    update();
    show();
  });
  document.addEventListener("keychange", update);
  update();
}

document.getElementById("skip").addEventListener("click", () => main.focus());
window.addEventListener("hashchange", () => {
  show();
  main.focus({ preventScroll: true });
  window.scrollTo(0, 0);
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => document.dispatchEvent(new Event("themechange")));
themeButton();
keyButton();
show();
