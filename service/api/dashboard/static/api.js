// Client of the service's API. Errors are ApiError; after a 401 it asks for a key and retries.

import { askForKey, key } from "./keys.js";

/** Error of the API: HTTP status, error code, message and detail. Status 0: the service did not answer. */
export class ApiError extends Error {
  constructor(status, code, message, detail = []) {
    super(message);
    Object.assign(this, { name: "ApiError", status, code, detail });
  }
}

export const get = (path, params, signal) => send("GET", path, { params, signal });
export const post = (path, body, signal) => send("POST", path, { body, signal });
export const put = (path, body, signal) => send("PUT", path, { body, signal });
export const patch = (path, body, signal) => send("PATCH", path, { body, signal });
export const del = (path, signal) => send("DELETE", path, { signal });

/** Return a path with its values percent-encoded: path`/v1/models/${name}`. */
export function path(parts, ...values) {
  return parts.reduce((all, part, index) => all + encodeURIComponent(values[index - 1]) + part);
}

/** Return up to `limit` items of a list, newest first; read as many pages as needed. */
export async function pages(address, limit = 200, params = {}, signal = undefined) {
  const found = [];
  let cursor = null;
  do {
    const page = await get(address, { ...params, ...(cursor ? { cursor } : {}) }, signal);
    found.push(...page.items);
    cursor = page.next_cursor;
  } while (cursor && found.length < limit);
  return found.slice(0, limit);
}

/** Yield server-sent events {event, data} until the response ends or the signal aborts; throw ApiError on an error status. */
export async function* events(address, signal) {
  const answer = await request("GET", address, { signal, headers: { accept: "text/event-stream" } });
  const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  try {
    for (;;) {
      const { value, done } = await reader.read();
      if (done) return;
      text = (text + value).replaceAll("\r\n", "\n");
      const blocks = text.split("\n\n");
      text = blocks.pop();
      for (const block of blocks) {
        const found = { event: "message", data: "" };
        for (const line of block.split("\n")) {
          if (line.startsWith("event:")) found.event = line.slice(6).trim();
          else if (line.startsWith("data:")) found.data += line.slice(5).trim();
        }
        if (found.data) yield { event: found.event, data: JSON.parse(found.data) };
      }
    }
  } finally {
    reader.cancel().catch(() => {});
  }
}

/** Upload a File to `where` and return the created object. onProgress receives the share sent, 0 to 1. */
export async function upload(file, params = {}, onProgress = () => {}, signal = undefined, where = "/v1/datasets") {
  const form = new FormData();
  form.append("file", file, file.name);
  for (;;) {
    const answer = await sendForm(form, withQuery(where, params), onProgress, signal);
    if (answer.status === 401 && (await askForKey(errorMessage(answer.body)))) continue;
    if (answer.status >= 200 && answer.status < 300) return answer.body;
    throw apiError(answer.status, answer.body);
  }
}

// fetch does not report the progress of an upload; XMLHttpRequest does
function sendForm(form, url, onProgress, signal) {
  return new Promise((resolve, reject) => {
    const sending = new XMLHttpRequest();
    sending.open("POST", url);
    for (const [name, value] of Object.entries(authorization())) sending.setRequestHeader(name, value);
    sending.upload.onprogress = (event) => event.lengthComputable && onProgress(event.loaded / event.total);
    sending.onload = () => resolve({ status: sending.status, body: parseJson(sending.responseText) });
    sending.onerror = () => reject(unreachableError());
    sending.onabort = () => reject(new DOMException("the upload was cancelled", "AbortError"));
    signal?.addEventListener("abort", () => sending.abort());
    sending.send(form);
  });
}

async function send(method, where, { params, body, signal }) {
  const headers = body === undefined ? {} : { "content-type": "application/json" };
  const content = body === undefined ? undefined : JSON.stringify(body);
  const answer = await request(method, withQuery(where, params), { signal, headers, body: content });
  return answer.status === 204 ? null : answer.json();
}

async function request(method, url, { signal, headers = {}, body }) {
  for (;;) {
    let answer;
    try {
      answer = await fetch(url, { method, body, signal, headers: { ...headers, ...authorization() } });
    } catch (error) {
      if (error.name === "AbortError") throw error;
      throw unreachableError();
    }
    if (answer.ok) return answer;
    const content = parseJson(await answer.text());
    if (answer.status === 401 && (await askForKey(errorMessage(content)))) continue;
    throw apiError(answer.status, content);
  }
}

function withQuery(where, params = {}) {
  const given = Object.entries(params ?? {}).filter(([, value]) => value !== null && value !== undefined && value !== "");
  return given.length ? `${where}?${new URLSearchParams(given)}` : where;
}

function authorization() {
  return key() ? { authorization: `Bearer ${key()}` } : {};
}

function parseJson(text) {
  try {
    return JSON.parse(text);
  } catch {
    return null;
  }
}

function errorMessage(body) {
  return body?.error?.message ?? "";
}

function apiError(status, body) {
  const error = body?.error;
  return new ApiError(status, error?.code ?? "unknown", error?.message ?? `The service answered with status ${status}.`, error?.detail);
}

function unreachableError() {
  return new ApiError(0, "unreachable", "The service does not answer. Check that it is running and that this machine can reach it.");
}
