// A version as an archive, fetched with the key where one is needed and handed to the browser as a file.

import { ApiError } from "../../api.js";
import { h } from "../../dom.js";
import { key } from "../../keys.js";

/** Save a version's archive. */
export async function exportVersion(name, version) {
  const headers = key() ? { authorization: `Bearer ${key()}` } : {};
  const answer = await fetch(`/v1/models/${encodeURIComponent(name)}/export?version=${version}`, { headers });
  if (!answer.ok) {
    const said = (await answer.json()).error;
    throw new ApiError(answer.status, said.code, said.message, said.detail);
  }
  const address = URL.createObjectURL(await answer.blob());
  const file = /filename="?([^";]+)"?/.exec(answer.headers.get("content-disposition") ?? "")?.[1];
  h("a", { href: address, download: file ?? `${name}-v${version}.tar` }).click();
  setTimeout(() => URL.revokeObjectURL(address), 60_000);
}
