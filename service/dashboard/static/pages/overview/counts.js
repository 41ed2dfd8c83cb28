// How much of everything there is.

import { h, refresh } from "../../dom.js";
import { changed } from "./follow.js";

/** Tiles with numbers; a page of a list that goes on is counted as "at least". */
export function counts(place, { data, models, jobs }) {
  const running = jobs.items.filter((job) => job.state === "running").length;
  const waiting = jobs.items.filter((job) => job.state === "queued").length;
  const tiles = [
    ["Data sets", number(data), "#/data"],
    ["Models", number(models), "#/models"],
    ["Jobs running", String(running), "#/jobs"],
    ["Jobs waiting", String(waiting), "#/jobs"],
  ];
  if (!changed(place, tiles)) return;
  refresh(
    place,
    h(
      "div",
      { class: "tiles" },
      tiles.map(([label, value, where]) =>
        h("a", { class: "tile", href: where }, h("span", { class: "big" }, value), " ", h("span", { class: "muted" }, label)),
      ),
    ),
  );
}

function number(page) {
  return page.next_cursor ? `${page.items.length}+` : String(page.items.length);
}
