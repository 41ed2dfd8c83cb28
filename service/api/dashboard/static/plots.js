// Plots by Plotly, whose JavaScript is loaded in two parts, each when it first has something to draw. Colours follow the page's theme.

import { css, faint, jointColour } from "./colours.js";
import { h } from "./dom.js";

const SPATIAL = new Set(["scatter3d", "mesh3d"]);
const loading = new Map();

/** Plotly, once it is there: its part that draws plots with two axes, or with "gl3d" scenes in 3-D. */
export function plotly(bundle = "cartesian") {
  if (!loading.has(bundle)) loading.set(bundle, load(bundle));
  return loading.get(bundle);
}

function load(bundle) {
  return new Promise((resolve, reject) => {
    const script = h("script", { src: `/dashboard/plotly/${bundle}.js` });
    script.onload = () => resolve(window.Plotly); // each part by itself: one replaces the other there
    script.onerror = () => {
      loading.delete(bundle);
      reject(new Error("Plotly's JavaScript could not be loaded from the service: where it runs, pip install plotly"));
    };
    document.head.append(script);
  });
}

/**
 * Draw traces into an element and keep them in the page's colours.
 * layout: Plotly's, and `title`, `x`, `y` (texts of the axes), `height`; label: what it shows, for screen readers.
 * Returns {element, react(traces, layout), extend(update, indices, most)}.
 */
export async function plot(element, traces, layout = {}, { label = "", signal = null } = {}) {
  const Plotly = await plotly(traces.flat().some(({ type }) => SPATIAL.has(type)) ? "gl3d" : "cartesian");
  element.classList.add("plot");
  element.setAttribute("role", "img");
  element.setAttribute("aria-label", label || layout.title || "plot");
  let last = [traces, layout];
  const draw = () => Plotly.react(element, painted(last[0]), themed(last[1]), CONFIG);
  await Plotly.newPlot(element, painted(traces), themed(layout), CONFIG);
  const again = () => (element.isConnected ? draw() : document.removeEventListener("themechange", again));
  document.addEventListener("themechange", again);
  signal?.addEventListener("abort", () => {
    document.removeEventListener("themechange", again);
    Plotly.purge(element);
  });
  return {
    element,
    react(newTraces, newLayout = last[1]) {
      last = [newTraces, newLayout];
      return draw();
    },
    extend: (update, indices, most) => Plotly.extendTraces(element, update, indices, most),
  };
}

/** A line. colour: a number of `colours`, or a name of a CSS variable such as "measured". */
export function line(x, y, name, colour, extra = {}) {
  return { x, y, name, mode: "lines", type: "scatter", colour, line: { width: 1.5 }, hoverlabel: { namelength: -1 }, ...extra };
}

/** The area between two curves, one entry of the legend. */
export function band(x, lower, upper, name, colour) {
  const edge = { x, mode: "lines", type: "scatter", colour, hoverinfo: "skip", legendgroup: name, line: { width: 0 } };
  return [
    { ...edge, y: lower, showlegend: false, name: `${name}, lower` },
    { ...edge, y: upper, fill: "tonexty", name, filled: true },
  ];
}

/** Colours of n joints, in the page's theme. */
export function colours(n) {
  return Array.from({ length: n }, (_, index) => jointColour(index));
}

// without its bar of buttons: they cannot be reached by keys in what is a picture, and one would send the plot to another host
const CONFIG = { responsive: true, displayModeBar: false };

/** A text that Plotly shows as it is: it takes some HTML for markup, and names of joints are anybody's. */
export function literal(text) {
  return String(text).replaceAll("&", "&amp;").replaceAll("<", "&lt;");
}

function painted(traces) {
  return traces.flat().map(({ colour, filled, ...given }) => {
    const trace = { ...given };
    if (trace.name !== undefined) trace.name = literal(trace.name);
    if (trace.text !== undefined) trace.text = Array.isArray(trace.text) ? trace.text.map(literal) : literal(trace.text);
    if (colour === undefined) return trace;
    const found = typeof colour === "number" ? jointColour(colour) : css(colour) || colour;
    const made = { ...trace, line: { color: found, ...trace.line } };
    if (trace.marker || trace.mode?.includes("markers")) made.marker = { color: found, ...trace.marker };
    if (filled) made.fillcolor = faint(found, 0.22);
    return made;
  });
}

function themed({ title = "", x = "", y = "", height = 300, ...rest }) {
  const axis = { gridcolor: css("line"), zerolinecolor: css("line-strong"), linecolor: css("line-strong"), automargin: true };
  const own = (name, text) => ({ ...axis, ...rest[name], title: { text: literal(text), standoff: 8, ...rest[name]?.title } });
  return {
    margin: { l: 56, r: 16, t: title ? 40 : 16, b: 44 },
    legend: { orientation: "h", y: -0.22, yanchor: "top" },
    hovermode: "x unified",
    ...rest,
    title: title ? { text: literal(title), x: 0, xanchor: "left", font: { size: 15 } } : undefined,
    height,
    autosize: true,
    paper_bgcolor: "rgba(0,0,0,0)",
    plot_bgcolor: "rgba(0,0,0,0)",
    font: { family: "inherit", size: 12.5, color: css("text") },
    hoverlabel: { bgcolor: css("surface"), bordercolor: css("line-strong"), font: { color: css("text") } },
    xaxis: own("xaxis", x),
    yaxis: own("yaxis", y),
  };
}
