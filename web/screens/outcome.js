// Outcome: one sentence, the slip, the code, done. It can be opened again that day; nobody is asked "are you sure?".

import { markOf } from "./home.js";
import { icon } from "../icons.js";
import { underway } from "../memory.js";
import { numberWords, personWords, slotWords, tiles } from "../parts.js";
import { html, nothing, svg } from "../vendor/lit-html.js";
import { calendarDay, clockTime, t } from "../words.js";

export function outcome(state, act) {
  const { visit } = state;
  if (!visit) return nothing;
  if (state.finishing === visit.id) return stillMaking(state, act);
  if (!visit.outcome) return notYet(act, visit);
  return html`
    <section class="outcome" data-outcome=${visit.outcome.code}>
      <h2>${t("outcome.title", { number: numberWords(visit.number) })}</h2>
      <p class="verdict">${icon(markOf(visit.outcome))} ${ending(state)[0]}</p>
      <p>${ending(state)[1]} ${state.status?.sending || visit.outcome.code !== "send" ? nothing : t("outcome.copy")}</p>
      ${state.status?.sending ? html`<p id="by-itself">${t("outcome.byitself")}</p>` : nothing} ${tiles(state, act)}
      <div class="ends">
        <button type="button" id="print" @click=${act.print}>${t("outcome.print")}</button>
        <button type="button" id="code" aria-expanded=${state.code !== undefined} @click=${act.showCode}>
          ${t("outcome.code")}
        </button>
        <button type="button" id="film" @click=${() => act.go({ screen: "film", visit: visit.id })}>${t("outcome.film")}</button>
        ${openAgain(visit, act)}
        <button class="primary big" type="button" id="done" @click=${() => act.go({ screen: "home" })}>
          ${t("outcome.done")}
        </button>
      </div>
      ${state.code ? code(state.code) : nothing} ${slip(state)}
    </section>
  `;
}

/** A finished visit is to be looked at, unless it is opened again, as long as the instrument allows it. */
export const openAgain = ({ undo_until: allowed }, act) =>
  allowed
    ? html`<button type="button" id="reopen" @click=${act.reopen}>${icon("again")} ${t("outcome.reopen")}</button>`
    : nothing;

// How it ends is told when every picture is there: before, nobody can know.
function stillMaking(state, act) {
  const shots = underway(state, state.visit.id);
  return html`<section class="outcome" id="finishing">
    <h2>${icon("wait")} ${t("outcome.making", { n: Math.max(1, shots.length) })}</h2>
    ${shots.map(
      ({ slot, stage }) => html`<label class="making">
        ${slotWords(state, slot).eye} · ${slotWords(state, slot).part}
        <progress max="1" .value=${stage.fraction}></progress>
      </label>`,
    )}
    ${tiles(state, act)}
  </section>`;
}

function notYet(act, visit) {
  return html`<section class="outcome">
    <h2>${t("outcome.open")}</h2>
    <button class="primary big" type="button" @click=${() => act.resume(visit)}>
      ${t("home.continue", { number: numberWords(visit.number) })}
    </button>
  </section>`;
}

/** How it ends: the instrument's sentence, which is English; in another language that language's word comes before it. */
export const ending = ({ visit: { outcome: { code, sentence } }, language }) => {
  if (language === "en") return [sentence, ""];
  return [t(`outcome.${code}`), code === "send" ? "" : sentence]; // of pictures that are kept it says no more
};

/** What the code says: number, date, outcome, telephone of the centre. Never a picture, a name or an age. */
export function codeText({ visit, protocol }) {
  const day = (visit.finished_at ?? visit.begun_at).slice(0, 10);
  return [visit.number, day, visit.outcome.code, protocol?.programme?.centre_phone].filter(Boolean).join("\n");
}

function code({ size, path }) {
  return html`<figure class="code">
    <svg viewBox=${`-4 -4 ${size + 8} ${size + 8}`} role="img" aria-label=${t("outcome.code.name")} shape-rendering="crispEdges">
      ${svg`<rect x="-4" y="-4" width=${size + 8} height=${size + 8} fill="#fff"></rect><path d=${path} fill="#000"></path>`}
    </svg>
    <figcaption class="muted">${t("outcome.code.name")}</figcaption>
  </figure>`;
}

// Only on paper: the print style sheet shows this and nothing else.
function slip(state) {
  const { visit, protocol, code: drawn } = state;
  const phone = protocol?.programme?.centre_phone;
  const moment = visit.finished_at ?? visit.begun_at;
  return html`<section class="slip" aria-hidden="true">
    <p class="slip-number">${personWords(visit)}</p>
    <p>${calendarDay(moment)}, ${clockTime(moment)}</p>
    <p class="slip-outcome">${ending(state)[0]}</p>
    <p>${ending(state)[1]}</p>
    ${phone ? html`<p>${t("outcome.phone", { phone })}</p>` : nothing} ${drawn ? code(drawn) : nothing}
  </section>`;
}
