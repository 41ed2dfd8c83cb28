// Plots by Plotly in the colours of the theme. Each of its two bundles is loaded when it is first needed.

import { css, withOpacity, jointColour } from "./colours.js";

const CORNER_PX = 5; // keeps the first label of the x axis away from the lowest one of the y axis
const SPATIAL = new Set(["scatter3d", "mesh3d"]);
const loading = new Map();

/** Load a bundle of Plotly and return it: "cartesian" for plots with two axes, "gl3d" for 3-D scenes. */
export function plotly(bundle = "cartesian") {
  if (!loading.has(bundle)) loading.set(bundle, load(bundle));
  return loading.get(bundle);
}

function load(bundle) {
  return new Promise((resolve, reject) => {
    const script = Object.assign(document.createElement("script"), { src: `/dashboard/plotly/${bundle}.js` });
    script.onload = () => resolve(window.Plotly); // each bundle replaces the other in window.Plotly
    script.onerror = () => {
      loading.delete(bundle);
      reject(new Error("Plotly could not be loaded from the service. Run `pip install plotly` on the service's machine."));
    };
    document.head.append(script);
  });
}

/**
 * Draw traces into an element and keep them in the colours of the theme.
 * layout: Plotly's layout, with `title`, `x` and `y` (axis titles) and `height`; label: description for screen readers.
 * Returns {element, react(traces, layout), extend(update, indices, most)}.
 */
export async function plot(element, traces, layout = {}, { label = "", signal = null } = {}) {
  const Plotly = await plotly(traces.flat().some(({ type }) => SPATIAL.has(type)) ? "gl3d" : "cartesian");
  element.classList.add("plot");
  element.setAttribute("role", "img");
  element.setAttribute("aria-label", label || layout.title || "plot");
  let last = [traces, layout];
  const draw = () => Plotly.react(element, withColours(last[0]), withTheme(last[1]), CONFIG);
  await Plotly.newPlot(element, withColours(traces), withTheme(layout), CONFIG);
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

/** Return a line. colour: the index of a joint, or the name of a CSS variable such as "measured". */
export function line(x, y, name, colour, extra = {}) {
  return { x, y, name, mode: "lines", type: "scatter", colour, line: { width: 1.5 }, hoverlabel: { namelength: -1 }, ...extra };
}

/** Return the area between two curves, with one entry in the legend. */
export function band(x, lower, upper, name, colour) {
  const edge = { x, mode: "lines", type: "scatter", colour, hoverinfo: "skip", legendgroup: name, line: { width: 0 } };
  return [
    { ...edge, y: lower, showlegend: false, name: `${name}, lower` },
    { ...edge, y: upper, fill: "tonexty", name, filled: true },
  ];
}

/** Return the colours of n joints in the current theme. */
export function colours(n) {
  return Array.from({ length: n }, (_, index) => jointColour(index));
}

// without Plotly's mode bar: its buttons cannot be reached by keyboard, and one sends the plot to another host
const CONFIG = { responsive: true, displayModeBar: false };

/** Escape text for Plotly, which interprets some HTML: joint names come from users. */
export function escapeMarkup(text) {
  return String(text).replaceAll("&", "&amp;").replaceAll("<", "&lt;");
}

function withColours(traces) {
  return traces.flat().map(({ colour, filled, ...given }) => {
    const trace = { ...given };
    if (trace.name !== undefined) trace.name = escapeMarkup(trace.name);
    if (trace.text !== undefined) trace.text = Array.isArray(trace.text) ? trace.text.map(escapeMarkup) : escapeMarkup(trace.text);
    if (colour === undefined) return trace;
    const found = typeof colour === "number" ? jointColour(colour) : css(colour) || colour;
    const made = { ...trace, line: { color: found, ...trace.line } };
    if (trace.marker || trace.mode?.includes("markers")) made.marker = { color: found, ...trace.marker };
    if (filled) made.fillcolor = withOpacity(found, 0.22);
    return made;
  });
}

function withTheme({ title = "", x = "", y = "", height = 300, ...rest }) {
  const axis = { gridcolor: css("line"), zerolinecolor: css("line-strong"), linecolor: css("line-strong"), automargin: true };
  const own = (name, text) => ({ ...axis, ...rest[name], title: { text: escapeMarkup(text), standoff: 8, ...rest[name]?.title } });
  return {
    margin: { l: 56, r: 16, t: title ? 40 : 16, b: 44 },
    legend: { orientation: "h", y: -0.22, yanchor: "top" },
    hovermode: "x unified",
    ...rest,
    title: title ? { text: escapeMarkup(title), x: 0, xanchor: "left", font: { size: 15 } } : undefined,
    height,
    autosize: true,
    paper_bgcolor: "rgba(0,0,0,0)",
    plot_bgcolor: "rgba(0,0,0,0)",
    font: { family: "inherit", size: 12.5, color: css("text") },
    hoverlabel: { bgcolor: css("surface"), bordercolor: css("line-strong"), font: { color: css("text") } },
    ...Object.fromEntries(Object.keys(rest).filter((name) => /^[xy]axis\d+$/.test(name)).map((name) => [name, own(name, "")])),
    xaxis: { ticklabelstandoff: CORNER_PX, ...own("xaxis", x) },
    yaxis: own("yaxis", y),
  };
}
