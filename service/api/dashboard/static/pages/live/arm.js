// Drawing of the arm at the newest positions of the stream, if the version has a geometry.

import { Card, Drawn } from "../../components.js";
import { html, useEffect, useMemo, useRef } from "../../preact.js";
import { AMBIGUITY_NOTE, drawable, drawing } from "../arm/drawing.js";
import { Explanation } from "./explanation.js";
import { useSeen } from "./live_plot.js";

const HEIGHT = 256;

/** The arm of a version at positions q; null: unknown. joint: highlighted axis. */
export function LiveArm({ version, q, joint }) {
  const isDrawable = useMemo(drawable, []); // each call creates a WebGL context, and a browser has few
  if (!version.parameters.geometry || q === null || !isDrawable) return null;
  return html`<${Card} title="Arm">
    <${Figure} version=${version} q=${q} joint=${joint} />
    <${Explanation}>Positions of the newest row. The axis of the enlarged joint, or of the one with the largest innovation, is thick. ${AMBIGUITY_NOTE}<//>
  <//>`;
}

function Figure({ version, q, joint }) {
  const place = useRef(null), made = useRef(null), isBusy = useRef(false);
  const seen = useSeen(place);
  const begin = async (element, signal) => {
    made.current = await drawing(element, version, q, { height: HEIGHT, legend: false, signal });
  };
  useEffect(() => {
    if (!made.current || !seen.current || isBusy.current) return;
    isBusy.current = true;
    made.current.draw(q, joint).finally(() => (isBusy.current = false));
  }, [q, joint]);
  return html`<div ref=${place} style=${{ height: `${HEIGHT}px` }}><${Drawn} draw=${begin} inputs=${[]} /></div>`;
}
