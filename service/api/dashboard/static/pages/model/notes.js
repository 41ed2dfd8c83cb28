// The note and the tags of a version, and the form that changes them in place.

import { patch } from "../../api.js";
import { Button, Field } from "../../components.js";
import { html, useEffect, useRef, useState } from "../../preact.js";

/** The note and the tags of a version as text. */
export function NoteText({ note, tags }) {
  return html`${note && html`<span class="note">${note}</span> `}${tags.map((tag) => html`<span class="badge plain">${tag}</span> `)}`;
}

/** The note and the tags of a version with a button that opens the form. changed(text): after they are saved. */
export function Note({ where, version, changed }) {
  const { version: number, note, tags } = version, verb = note || tags.length ? "Edit" : "Add";
  const [open, setOpen] = useState(false), cell = useRef(null), before = useRef(false);
  useEffect(() => {
    if (open !== before.current) cell.current.querySelector(open ? "textarea" : "button").focus();
    before.current = open;
  }, [open]);
  const close = () => setOpen(false);
  const save = async (body) => {
    await patch(`${where}/versions/${number}`, body);
    close();
    changed(`Note of version ${number} saved.`);
  };
  if (open) return html`<div class="note-cell" ref=${cell}><${Form} note=${note} tags=${tags} save=${save} close=${close} /></div>`;
  return html`<div class="note-cell" ref=${cell}>
    <${NoteText} note=${note} tags=${tags} />
    <${Button} label=${`${verb} note: version ${number}`} onclick=${() => setOpen(true)}>${verb}<//>
  </div>`;
}

function Form({ note, tags, save, close }) {
  const [text, setText] = useState(note ?? ""), [words, setWords] = useState(tags.join(", ")), form = useRef(null);
  const send = () => save({ note: text, tags: words.split(",").map((each) => each.trim()).filter(Boolean) });
  const press = (event) => {
    if (event.key === "Escape") close();
    if (event.key !== "Enter" || !(event.target.matches("input") || event.ctrlKey)) return;
    event.preventDefault();
    form.current.querySelector("button.primary").click();
  };
  return html`<form ref=${form} onSubmit=${(event) => event.preventDefault()} onKeyDown=${press}>
    <${Field} label="Note" input=${(attributes) => html`<textarea ...${attributes} rows="2" maxlength="500" value=${text} onInput=${(event) => setText(event.target.value)}></textarea>`} />
    <${Field} label="Tags" hint="Separated by commas." input=${(attributes) => html`<input ...${attributes} type="text" autocomplete="off" value=${words} onInput=${(event) => setWords(event.target.value)} />`} />
    <div class="actions"><${Button} kind="primary" onclick=${send}>Save<//><${Button} onclick=${close}>Cancel<//></div>
  </form>`;
}
