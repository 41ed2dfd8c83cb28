// A version as an archive or as C, and its arm as a URDF: fetched with the key where one is needed and handed to the browser as a file.

import { ApiError } from "../../api.js";
import { h } from "../../dom.js";
import { key } from "../../keys.js";

/** Save a version's archive. */
export function exportVersion(name, version) {
  return save(name, version, "export", "tar");
}

/** Save the arm that a version has learnt as a URDF. */
export function saveUrdf(name, version) {
  return save(name, version, "urdf", "urdf");
}

/** Save a version as C99, in an archive of two files. */
export function saveC(name, version) {
  return save(name, version, "export", "tar", "&format=c");
}

async function save(name, version, what, ending, more = "") {
  const headers = key() ? { authorization: `Bearer ${key()}` } : {};
  const answer = await fetch(`/v1/models/${encodeURIComponent(name)}/${what}?version=${version}${more}`, { headers });
  if (!answer.ok) {
    const said = (await answer.json()).error;
    throw new ApiError(answer.status, said.code, said.message, said.detail);
  }
  const address = URL.createObjectURL(await answer.blob());
  const file = /filename="?([^";]+)"?/.exec(answer.headers.get("content-disposition") ?? "")?.[1];
  h("a", { href: address, download: file ?? `${name}-v${version}.${ending}` }).click();
  setTimeout(() => URL.revokeObjectURL(address), 60_000);
}
