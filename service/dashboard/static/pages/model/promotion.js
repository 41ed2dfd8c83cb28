// Whether a trained version answers by itself, and why.

import { h } from "../../dom.js";

/** What came of its judgement; nothing where it was not judged. */
export function promoted({ version, promotion }) {
  if (!promotion || promotion.passed === null) return null;
  if (promotion.passed) return h("p", { class: "hint" }, `It answers by itself: ${promotion.reason}.`);
  const what = promotion.answers ? `Version ${version} answered, though it did not do well on what was held out` : `Version ${version} waits as candidate and did not answer by itself`;
  return h("div", { class: "banner", role: "note" }, h("strong", {}, `${what}: `), `${promotion.reason}.`);
}
