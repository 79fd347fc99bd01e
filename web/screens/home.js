// Home screen: new patient, unfinished visit, counts of the day, language. Find screen: number pad and today's
// patients.

import { icon } from "../components/icons.js";
import { choice, numberPad, patientLabel } from "../components/components.js";
import { displayNumber, isNumber } from "../core/numbers.js";
import { html, nothing } from "../vendor/lit-html.js";
import { calendarDay, clockTime, LANGUAGES, t, today } from "../i18n/translate.js";

/** @typedef {import("../core/state.js").State} State */

/** @param {State} state */
export function home(state, actions) {
  const { visits, counts, status } = state;
  const unfinished = (visits ?? []).find((visit) => !visit.finished_at);
  return html`
    <section class="home">
      <button class="primary big" type="button" id="new" @click=${() => actions.begin()}>${icon("person")} ${t("home.new")}</button>
      ${unfinished
        ? html`<button class="big" type="button" id="continue" @click=${() => actions.resume(unfinished)}>
            ${icon("next")} <span>${t("home.continue", { number: displayNumber(unfinished.number) })}${earlierDay(unfinished)}</span>
          </button>`
        : nothing}
      <div class="pair">
        <button type="button" id="find" @click=${() => actions.go({ screen: "find" })}>${t("home.find")}</button>
        <button type="button" id="history" @click=${() => actions.go({ screen: "history" })}>${t("home.history")}</button>
      </div>
      ${counts ? dayCounts(counts) : nothing} ${status?.sending ? sendingButton(status.sending, actions) : nothing} ${languages(state, actions)}
    </section>
  `;
}

// The day of a visit that was not begun today, so that it is not taken for the present patient's.
const earlierDay = ({ day }) => (day === today() ? "" : ` · ${calendarDay(`${day}T12:00`)}`);

function dayCounts({ done, to_finish: open, referred, declined }) {
  return html`
    <p class="day">
      <b>${t("home.today")}</b> <span>${t("home.done", { count: done })}</span> <span>${t("home.open", { count: open })}</span>
      <span>${t("home.referred", { count: referred })}</span> ${declined ? html`<span>${t("home.declined", { count: declined })}</span>` : nothing}
    </p>
  `;
}

const sendingButton = ({ sent, waiting }, actions) =>
  html`<button class="quiet" type="button" id="send" @click=${() => actions.go({ screen: "send" })}>
    ${icon(waiting ? "wait" : "check")} <span>${t("home.sent", { count: sent })} · ${t("home.waiting", { count: waiting })}</span>
  </button>`;

/** @param {State} state */
function languages({ language }, actions) {
  const draft = LANGUAGES[language]?.draft;
  const options = Object.entries(LANGUAGES).map(([tag, { name }]) => [tag, name]);
  return html`
    <section class="languages">
      <h2>${t("home.language")}</h2>
      ${choice({ label: t("home.language"), value: language, options, choose: actions.setLanguage })}
      ${draft ? html`<p class="muted">${t("home.draft")}</p>` : nothing}
    </section>
  `;
}

/** @param {State} state */
export function find({ typed, visits }, actions) {
  const found = (visits ?? []).filter(({ number }) => number.includes(typed) || displayNumber(number).includes(typed)).slice(0, 20);
  const match = visits && typed ? found.find((visit) => isNumber(visit, typed)) : undefined;
  return html`
    <section class="find">
      <div>
        <h2>${t("find.title")}</h2>
        <p class="typed" aria-live="polite">${typed || "\u00a0"}</p>
        ${numberPad(actions.typeNumber)}
        ${match
          ? html`<button class="primary" type="button" id="open-found" @click=${() => actions.resume(match)}>
              ${t("find.open.one", { number: displayNumber(match.number) })}
            </button>`
          : html`<p class="no-match" aria-live="polite">
              ${typed && visits ? t(found.length ? "find.choose" : "find.nomatch", { number: typed }) : "\u00a0"}
            </p>`}
        <button class=${found.length ? "" : "primary"} type="button" id="start" ?hidden=${!typed} @click=${() => actions.begin(typed)}>
          ${t("find.start", { number: typed })}
        </button>
        <p class="muted">${t("find.scan")}</p>
      </div>
      <div>
        <h2 ?hidden=${typed && !found.length}>${typed ? t("home.today.typed", { number: typed }) : t("home.today")}</h2>
        ${found.length ? patientList(found, actions.resume) : typed ? nothing : html`<p class="muted">${t("find.none")}</p>`}
      </div>
    </section>
  `;
}

/** Icon of an outcome: a tick would suggest that nothing remains to be done. */
export const outcomeIcon = ({ code }) => (code.startsWith("refer") ? "warn" : code === "declined" ? "cross" : "next");

export function patientList(visits, open) {
  return html`
    <ul class="people">
      ${visits.map((visit) => {
        const [name, word] = visit.outcome ? [outcomeIcon(visit.outcome), `outcome.${visit.outcome.code}`] : ["wait", "find.open"];
        return html`<li>
          <button type="button" data-visit=${visit.id} @click=${() => open(visit)}>
            <span>${patientLabel(visit)}</span> <span class="muted">${clockTime(visit.begun_at)}</span>
            <span class="end">${icon(name)} ${t(word)}</span>
          </button>
        </li>`;
      })}
    </ul>
  `;
}
