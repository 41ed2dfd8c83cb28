// Why a version became the serving version, or not.

import { h } from "../../dom.js";

/** Return a note on the promotion of a version; null if its verdict says it all, and for refreshed and shipped versions. */
export function promotionNote({ version, verdict, promotion }) {
  if (!promotion || (promotion.answers && verdict.serves)) return null;
  if (promotion.answers) return h("p", { class: "hint" }, `Version ${version} was promoted, although it is ${verdict.label}.`);
  if (!verdict.serves) return null;
  return h("div", { class: "banner", role: "note" }, h("strong", {}, `Version ${version} is a candidate.`), ` ${promotion.reason}`);
}
