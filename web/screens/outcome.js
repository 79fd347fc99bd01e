// Outcome screen: result, printed slip, QR code. There is no confirmation dialog: the visit can be reopened on the same
// day.

import { outcomeIcon } from "./home.js";
import { icon } from "../components/icons.js";
import { qrText } from "../core/visit.js";
import { pendingCaptures } from "../core/state.js";
import { fieldLabel, patientLabel, slotLabel, tiles } from "../components/components.js";
import { displayNumber } from "../core/numbers.js";
import { qrCode } from "../core/qr_code.js";
import { html, nothing, svg } from "../vendor/lit-html.js";
import { calendarDay, clockTime, has, t } from "../i18n/translate.js";

/** @typedef {import("../core/state.js").State} State */

/** @param {State} state */
export function outcome(state, actions) {
  const { visit } = state;
  if (!visit) return nothing;
  if (state.finishing === visit.id) return pendingPictures(visit, state, actions);
  if (!visit.outcome) return unfinishedVisit(actions, visit);
  const [headline, ...reasons] = outcomeTexts(visit.outcome);
  return html`
    <section class="outcome" data-outcome=${visit.outcome.code}>
      <h2 id="outcome-title" tabindex="-1">${t("outcome.title", { number: displayNumber(visit.number) })}</h2>
      <p class="verdict">${icon(outcomeIcon(visit.outcome))} ${headline}</p>
      ${reasons.length ? html`<ul class="reasons">${reasons.map((reason) => html`<li>${reason}</li>`)}</ul>` : nothing}
      ${directions(visit, state).map((line) => html`<p>${line}</p>`)}
      ${state.status?.sending || visit.outcome.code !== "send" ? nothing : html`<p>${t("outcome.copy")}</p>`}
      ${state.status?.sending && visit.outcome.code !== "declined" ? html`<p id="by-itself">${t("outcome.byitself")}</p>` : nothing} ${tiles(state, actions)}
      <div class="ends">
        <button class="primary big" type="button" id="done" @click=${() => actions.go({ screen: "home" })}>
          ${t("outcome.done")}
        </button>
        <button type="button" id="print" @click=${actions.print}>${t("outcome.print")}</button>
        <button type="button" id="code" aria-expanded=${state.isCodeShown} @click=${actions.toggleQrCode}>
          ${t("outcome.code")}
        </button>
        <button type="button" id="pictures" @click=${() => actions.go({ screen: "pictures", visit: visit.id })}>${t("outcome.pictures")}</button>
        ${reopenButton(visit, actions)}
      </div>
      ${state.isCodeShown ? qrFigure(visit, state) : nothing} ${slip(visit, [headline, ...reasons], state)}
    </section>
  `;
}

const REASONS = ["answer", "picture", "mistake"];

/** The reasons to reopen a finished visit, behind their button, as long as the server allows it. */
export const reopenButton = ({ undo_until: allowed }, actions) =>
  allowed
    ? html`<details class="reopen">
        <summary class="button" id="reopen">${icon("again")} ${t("outcome.reopen")}</summary>
        <div class="choice" role="group" aria-label=${t("reopen.why")}>
          ${REASONS.map((why) => html`<button type="button" data-reason=${why} @click=${() => actions.reopen(why)}><span>${t(`reopen.${why}`)}</span></button>`)}
        </div>
      </details>`
    : nothing;

// The outcome is known only after the last capture; until then its progress is shown.
/**
 * @param {import("../core/state.js").Visit} visit
 * @param {State} state
 */
function pendingPictures(visit, state, actions) {
  const captures = pendingCaptures(state, visit.id);
  return html`<section class="outcome" id="finishing">
    <h2>${icon("wait")} ${t("outcome.making", { count: Math.max(1, captures.length) })}</h2>
    ${captures.map(
      ({ slot, stage }) => html`<label class="making">
        ${slotLabel(state, slot).eye} · ${slotLabel(state, slot).part}
        <progress max="1" .value=${stage.fraction}></progress>
      </label>`,
    )}
    ${tiles(state, actions)}
  </section>`;
}

function unfinishedVisit(actions, visit) {
  return html`<section class="outcome">
    <h2>${t("outcome.open")}</h2>
    <button class="primary big" type="button" @click=${() => actions.resume(visit)}>
      ${t("home.continue", { number: displayNumber(visit.number) })}
    </button>
  </section>`;
}

/** Return the outcome's headline, and all its reasons. */
export const outcomeTexts = ({ code, reasons }) => [t(`outcome.${code}`), ...reasons.map(reasonText)];

function reasonText({ code, eye, field, value }) {
  if (code === "complaint") return t(`complaint.${value}`);
  if (code === "vision") return visionText(eye, value);
  if (code === "declined") return t("outcome.declined");
  const why = code === "not_possible" ? t(`reason.${value}`) : t(`outcome.${field ? code : "no_picture"}`);
  return `${[t(`eye.${eye}`), field && fieldLabel(field)].filter(Boolean).join(" · ")}: ${why}`;
}

const visionText = (eye, value) => `${t(`field.vision_${eye.toLowerCase()}`)}: ${has(`vision.${value}`) ? t(`vision.${value}`) : value}`;

/**
 * Return when and where the patient goes, of a referral, and the telephone of the centre.
 * @param {import("../core/state.js").Visit} visit
 * @param {State} state
 */
function directions({ outcome, finished_at: end }, { programme, language }) {
  const { centre_phone: phone, where, within_days: days } = programme?.referral ?? {};
  const place = where?.[language] ?? where?.en;
  const by = new Date(end ?? "");
  by.setDate(by.getDate() + (days ?? 0));
  return [
    outcome?.urgency === "today" && t("outcome.today"),
    outcome?.urgency === "soon" && t("outcome.soon", { date: calendarDay(by.toISOString()) }),
    outcome?.urgency !== "none" && place && t("outcome.where", { place }),
    phone && t("outcome.phone", { phone }),
  ].filter(Boolean);
}

/**
 * @param {import("../core/state.js").Visit} visit
 * @param {State} state
 */
function qrFigure(visit, state) {
  const { size, path } = qrCode(qrText(visit, state.programme));
  return html`<figure class="code">
    <svg viewBox=${`-4 -4 ${size + 8} ${size + 8}`} role="img" aria-label=${t("outcome.code.name")} shape-rendering="crispEdges">
      ${svg`<rect x="-4" y="-4" width=${size + 8} height=${size + 8} fill="#fff"></rect><path d=${path} fill="#000"></path>`}
    </svg>
    <figcaption class="muted">${t("outcome.code.name")}</figcaption>
  </figure>`;
}

// Shown only in print.
/**
 * @param {import("../core/state.js").Visit} visit
 * @param {string[]} texts
 * @param {State} state
 */
function slip(visit, [headline, ...lines], state) {
  const seen = ["OD", "OS"].filter((eye) => visit.fields[`vision_${eye.toLowerCase()}`] && !visit.outcome?.reasons.some((reason) => reason.code === "vision" && reason.eye === eye));
  const visions = seen.map((eye) => visionText(eye, visit.fields[`vision_${eye.toLowerCase()}`]));
  const moment = visit.finished_at ?? visit.begun_at;
  return html`<section class="slip" aria-hidden="true">
    ${state.programme?.letter?.name ? html`<p>${state.programme.letter.name}</p>` : nothing}
    <p class="slip-number">${patientLabel(visit)}</p>
    <p>${calendarDay(moment)}, ${clockTime(moment)}</p>
    <p class="slip-outcome">${headline}</p>
    ${[...lines, ...visions, ...directions(visit, state)].map((line) => html`<p>${line}</p>`)} ${qrFigure(visit, state)}
  </section>`;
}
