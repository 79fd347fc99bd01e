// Changes of a visit: who changed an answer, the outcome or the eye of a picture, when, what it was and is, and why.

import { fieldLabel, slotLabel } from "./components.js";
import { html } from "../vendor/lit-html.js";
import { calendarDay, clockTime, has, t } from "../i18n/translate.js";

/** @typedef {import("../core/state.js").State} State */

const TEXTS = { vision_od: "vision.", vision_os: "vision.", complaints: "complaint.", diabetes_years: "years.", glasses: "" };

/**
 * List that is loaded when it is opened.
 * @param {State} state
 */
export function visitChanges(state, actions) {
  const load = ({ target }) => target.open && actions.loadChanges();
  return html`<details class="changes" @toggle=${load}>
    <summary id="changes">${t("changes.title")}</summary>
    <ol>${state.changes.map((change) => item(change, state))}</ol>
  </details>`;
}

function item({ number, at, user, field, was, value, why }, state) {
  return html`<li class="change" value=${number}>
    ${has(`changes.${field}`) ? t(`changes.${field}`) : fieldLabel(field)}: ${text(field, was, state)} → <b>${text(field, value, state)}</b>
    <small>${calendarDay(at)}, ${clockTime(at)} · ${user || t("changes.device")}${why ? ` · ${t(`reopen.${why}`)}` : ""}</small>
  </li>`;
}

/** Return an answer in words; one without a translation as it is stored. */
function text(field, value, state) {
  if (value === null) return "–";
  if (field === "laterality") return Object.values(slotLabel(state, value)).join(", ");
  const words = (one) => (has(`${TEXTS[field] ?? `${field}.`}${one}`) ? t(`${TEXTS[field] ?? `${field}.`}${one}`) : String(one));
  return [value].flat().map(words).join(", ");
}
