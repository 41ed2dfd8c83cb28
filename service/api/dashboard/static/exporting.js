// Export of what a page shows: its plots as one PNG, their numbers as CSV.

import { css } from "./colours.js";
import { Button } from "./components.js";
import { escapeMarkup, plotly } from "./plots.js";
import { html, useRef } from "./preact.js";

const SCALE = 2; // pixels of the picture per CSS pixel
const NAME_SIZE = 11; // of the names that the page writes over plots
const KEYS = ".key > span, .joint-plots .joint"; // names beside their colours, which the page writes around plots
const FONT = "system-ui, sans-serif"; // a picture does not inherit the page's font

/**
 * Buttons that save the plots of an element as PNG and their numbers as CSV.
 * name: of the files; of(): the element; without, that around the buttons; table(): [[heading, …], [value, …], …].
 */
export function Export({ name, of, table }) {
  const self = useRef(null);
  const file = name.replace(/[^\p{L}\p{N}._-]+/gu, "-");
  const picture = async () => save(await pictureOf(of?.() ?? self.current.parentElement), `${file}.png`);
  const numbers = async () => save(new Blob([csv(await table())], { type: "text/csv" }), `${file}.csv`);
  return html`<div class="actions export" role="group" aria-label=${`Export ${name}`} ref=${self}>
    <${Button} onclick=${picture} label=${`Save ${name} as PNG`}>PNG<//>
    ${table && html`<${Button} onclick=${numbers} label=${`Save ${name} as CSV`}>CSV<//>`}
  </div>`;
}

/** Return rows of values as CSV; a value with a comma, a quote or a line break is quoted. */
export function csv(rows) {
  const text = (value) => (value === null || value === undefined ? "" : String(value));
  const cell = (value) => (/[",\r\n]/.test(text(value)) ? `"${text(value).replaceAll('"', '""')}"` : text(value));
  return `${rows.map((row) => row.map(cell).join(",")).join("\r\n")}\r\n`;
}

/** Draw all plots of an element with their keys, placed as on the page, and return the PNG. */
async function pictureOf(element) {
  const plots = [...element.querySelectorAll(".js-plotly-plot")].filter((each) => each.checkVisibility());
  if (!plots.length) throw new Error("There is no plot to save yet.");
  const keys = [...element.querySelectorAll(KEYS)].filter((each) => each.checkVisibility());
  const boxes = [...plots, ...keys].map((each) => each.getBoundingClientRect());
  const left = Math.min(...boxes.map((each) => each.left)), top = Math.min(...boxes.map((each) => each.top));
  const canvas = document.createElement("canvas");
  canvas.width = SCALE * (Math.max(...boxes.map((each) => each.right)) - left);
  canvas.height = SCALE * (Math.max(...boxes.map((each) => each.bottom)) - top);
  const paper = canvas.getContext("2d");
  paper.fillStyle = css("surface");
  paper.fillRect(0, 0, canvas.width, canvas.height);
  for (const [index, plot] of plots.entries()) {
    const { width, height, x, y } = boxes[index];
    paper.drawImage(await drawing(plot, width, height), SCALE * (x - left), SCALE * (y - top));
  }
  for (const [index, key] of keys.entries()) drawKey(paper, key, boxes[plots.length + index], left, top);
  return new Promise((resolve, reject) => canvas.toBlob((blob) => (blob ? resolve(blob) : reject(new Error("The plots are too large for one picture."))), "image/png"));
}

/** Draw a name and its colour at its place on the page. */
function drawKey(paper, key, { x, y, height }, left, top) {
  const sample = key.querySelector(".sample");
  const size = parseFloat(getComputedStyle(key).fontSize), middle = y - top + height / 2;
  paper.save();
  paper.scale(SCALE, SCALE);
  paper.fillStyle = sample ? getComputedStyle(sample).backgroundColor : getComputedStyle(key, "::before").backgroundColor;
  paper.globalAlpha = sample ? Number(getComputedStyle(sample).opacity) : 1;
  paper.fillRect(x - left, middle - size / 3, size, 0.66 * size);
  paper.globalAlpha = 1;
  paper.fillStyle = css("text");
  paper.font = `${size}px ${FONT}`;
  paper.textBaseline = "middle";
  paper.fillText(key.textContent, x - left + 1.4 * size, middle);
  paper.restore();
}

/** Return an image of one plot, with the names that the page writes over it: `layout.meta`, [{text, x, y}]. */
async function drawing({ data, layout }, width, height) {
  const Plotly = await plotly(data.some(({ type }) => type === "scatter3d" || type === "mesh3d") ? "gl3d" : "cartesian");
  const over = (layout.meta ?? []).map(({ text, x, y }) => ({ text: escapeMarkup(text), x, y, xref: "paper", yref: "paper", xanchor: "left", yanchor: "bottom", showarrow: false, font: { size: NAME_SIZE } }));
  const figure = { data, layout: { ...layout, annotations: [...(layout.annotations ?? []), ...over], font: { ...layout.font, family: FONT } } };
  const address = await Plotly.toImage(figure, { format: "png", width, height, scale: SCALE });
  const image = new Image();
  image.src = address;
  await image.decode();
  return image;
}

function save(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000); // some browsers read it late
}
