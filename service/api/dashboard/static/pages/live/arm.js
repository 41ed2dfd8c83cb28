// Drawing of the arm at the newest positions of the stream, if the version has a geometry.

import { get, path } from "../../api.js";
import { h, replace } from "../../dom.js";
import { card, explanation } from "../../ui.js";
import { AMBIGUITY_NOTE, drawable, drawing } from "../arm/drawing.js";

const HEIGHT = 256;

/** Create the drawing. Returns {draw(status, joint)}, which moves a visible arm to the positions pose(); joint: highlighted axis. */
export function liveArm(place, name, pose, signal) {
  let made = null, version = null, seen = false, at = null, highlighted = null, current = null;
  const watch = new IntersectionObserver((entries) => (seen = entries.at(-1).isIntersecting), { rootMargin: "200px 0px" });
  signal.addEventListener("abort", () => {
    watch.disconnect();
    current?.abort();
  });
  const begin = async (number, q) => {
    version = number;
    current?.abort();
    current = new AbortController();
    made = null;
    const found = await readVersion(name, number, signal);
    if (!found?.parameters.geometry || !drawable()) return replace(place);
    const figure = h("div", { style: `height: ${HEIGHT}px` });
    replace(place, card("Arm", figure, explanation(`Positions of the newest row. The axis of the joint in the large plot is thick. ${AMBIGUITY_NOTE}`)));
    watch.disconnect();
    watch.observe(figure);
    made = await drawing(figure, found, q, { height: HEIGHT, legend: false, signal: current.signal });
  };
  return {
    async draw(status, joint) {
      const q = pose();
      if (q === null || signal.aborted) return;
      if (status.version !== version) await begin(status.version, q);
      else if (made && seen && (q !== at || joint !== highlighted)) await made.draw(q, joint);
      [at, highlighted] = [q, joint];
    },
  };
}

/** Read a version; null if it was deleted or the page was left. */
async function readVersion(name, number, signal) {
  try {
    return await get(path`/v1/models/${name}/versions/${number}`, {}, signal);
  } catch (error) {
    if (error.name === "ApiError" || error.name === "AbortError") return null;
    throw error;
  }
}
