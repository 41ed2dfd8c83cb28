// Versions and aliases: serve, roll back, export, delete, compare.

import { del, get, path, post } from "../../api.js";
import { h, replace } from "../../dom.js";
import { ago, when } from "../../format.js";
import { listing } from "../../tables.js";
import { badge, button, card, confirm, field, loading, notice, select, table } from "../../ui.js";
import { QUALITY_HINT, qualityColumns } from "../quality.js";
import { compareForm } from "./compare.js";
import { exportVersion } from "./export.js";
import { moveAlias, servingButton } from "./serving.js";

/** Draw the tab. */
export async function versions(view, state, { signal, reload, select: viewVersion }) {
  replace(view, loading());
  const { items: aliases } = await get(`${state.where}/aliases`, {}, signal);
  replace(
    view,
    card("Versions", versionTable(state, aliases, reload, viewVersion)),
    card("Aliases", aliasTable(state, aliases, reload), aliasForm(state, reload)),
    state.model.versions.length > 1 ? card("Compare versions", compareForm(state, signal)) : null,
  );
}

function versionTable({ name, where, model, version }, aliases, reload, viewVersion) {
  const serving = model.serving_version;
  const named = (number) => aliases.filter((each) => each.version === number && each.alias !== "serving").map((each) => each.alias);
  const actions = (each) => {
    const number = each.version;
    const made = [button("View", () => viewVersion(number, "accuracy"))];
    if (number !== serving) made.push(button(each.verdict.serves ? "Serve" : "Serve anyway", async () => {
      if (await moveAlias({ name, where, model }, "serving", each)) await reloadAndNotify(reload, `Version ${number} of ${name} is now serving.`);
    }, { kind: servingButton(each)[1] }));
    made.push(button("Export", () => exportVersion(name, number)));
    if (number !== serving && !named(number).length) made.push(button("Delete", async () => {
      if (!(await confirm(`Delete version ${number} of ${name}? This cannot be undone.`, `Delete version ${number}`))) return;
      await del(`${where}/versions/${number}`);
      await reloadAndNotify(reload, `Version ${number} deleted.`);
    }, { kind: "danger" }));
    for (const press of made) press.setAttribute("aria-label", `${press.textContent}: version ${number}`);
    return h("div", { class: "actions" }, made);
  };
  const columns = [
    {
      label: "Version",
      value: (each) => each.version,
      first: "descending",
      cell: (each) => [
        `${each.version} `,
        each.version === serving ? badge("serving") : null,
        " ",
        named(each.version).map((alias) => [badge(alias, "plain"), " "]),
        each.version === version.version ? h("span", { class: "muted" }, "viewing") : null,
      ],
    },
    ...qualityColumns((each) => each.verdict),
    { label: "Estimator", value: (each) => each.estimator, cell: (each) => each.estimator },
    { label: "Created", value: (each) => each.created_at, first: "descending", cell: (each) => h("time", { datetime: each.created_at, title: when(each.created_at) }, ago(each.created_at)) },
    { label: "Actions", cell: actions },
  ];
  const list = listing(columns, {
    caption: "Versions, newest first",
    what: ["version", "versions"],
    key: (each) => each.version,
    words: (each) => [`version ${each.version}`, each.estimator, each.verdict.label, ...named(each.version)].join(" "),
    minRows: 4,
  });
  list.show([...model.versions].reverse());
  return [list.element, h("p", { class: "hint" }, QUALITY_HINT)];
}

function aliasTable({ name, where }, aliases, reload) {
  const back = (each) => button("Roll back", async () => {
    const what = each.alias === "serving" ? `Version ${each.previous} of ${name} will serve instead of version ${each.version}.` : `It will point to version ${each.previous} again.`;
    if (!(await confirm(`Roll back the alias “${each.alias}”? ${what}`, `Roll back to version ${each.previous}`, "primary"))) return;
    const now = await post(`${where}/aliases/${encodeURIComponent(each.alias)}/rollback`, {});
    await reloadAndNotify(reload, `${each.alias} → version ${now.version}`);
  });
  const remove = (each) => button("Remove", async () => {
    if (!(await confirm(`Remove the alias “${each.alias}”? Queries that name it will fail. Version ${each.version} is kept.`, "Remove alias"))) return;
    await del(path`/v1/models/${name}/aliases/${each.alias}`);
    await reloadAndNotify(reload, `Alias ${each.alias} removed.`);
  }, { kind: "danger" });
  const named = (made, each) => {
    made.setAttribute("aria-label", `${made.textContent}: ${each.alias}`);
    return made;
  };
  const columns = [
    { label: "Alias", cell: (each) => `${each.alias} → ${each.version}` },
    {
      label: "Actions",
      cell: (each) => h("div", { class: "actions" }, each.previous === null ? null : named(back(each), each), each.alias === "serving" ? null : named(remove(each), each)),
    },
    { label: "Previous", cell: (each) => (each.previous === null ? "–" : `version ${each.previous}`) },
    { label: "Changed", cell: (each) => when(each.changed_at) },
  ];
  return table(columns, aliases, { caption: "“serving” is used for queries that name no version; other aliases for queries that name them" });
}

function aliasForm({ where, model, name }, reload) {
  const alias = h("input", { type: "text", required: true, pattern: "[a-z][a-z0-9._\\-]{0,63}", placeholder: "production", autocomplete: "off", spellcheck: "false" });
  const version = select([...model.versions].reverse().map((each) => [String(each.version), `version ${each.version}`]), String(model.serving_version ?? model.latest_version));
  const set = button("Set alias", async () => {
    if (!alias.reportValidity()) return;
    const chosen = alias.value.trim(), number = Number(version.value);
    if (await moveAlias({ name, where, model }, chosen, model.versions.find((each) => each.version === number))) await reloadAndNotify(reload, `${chosen} → version ${number}`);
  });
  return h(
    "details",
    {},
    h("summary", {}, "Create or move an alias"),
    h("div", { class: "grid" }, field("Alias", alias, "A lower-case letter, then lower-case letters, digits, dots and hyphens."), field("Points to", version)),
    set,
  );
}

/** Reload the page, then show a notice, so that no button of the old state can be pressed. */
async function reloadAndNotify(reload, text) {
  try {
    await reload();
  } finally {
    notice(text); // the action succeeded even if the reload failed
  }
}
