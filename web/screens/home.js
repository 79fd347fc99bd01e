// Home: one big button, what is unfinished, how the day went, the language. Find: a number pad and today's people.

import { icon } from "../icons.js";
import { choice, numberWords, pad, personWords } from "../parts.js";
import { html, nothing } from "../vendor/lit-html.js";
import { clockTime, LANGUAGES, t } from "../words.js";

export function home(state, act) {
  const { visits, counts, status } = state;
  const left = (visits ?? []).find((visit) => !visit.finished_at);
  return html`
    <section class="home">
      <button class="primary big" type="button" id="new" @click=${() => act.begin()}>${icon("person")} ${t("home.new")}</button>
      ${left
        ? html`<button class="big" type="button" id="continue" @click=${() => act.resume(left)}>
            ${icon("next")} <span>${t("home.continue", { number: numberWords(left.number) })}</span>
          </button>`
        : nothing}
      <div class="pair">
        <button type="button" id="find" @click=${() => act.go({ screen: "find" })}>${t("home.find")}</button>
        <button type="button" id="history" @click=${() => act.go({ screen: "history" })}>${t("home.history")}</button>
      </div>
      ${counts ? day(counts) : nothing} ${status?.sending ? sending(status.sending, act) : nothing} ${languages(state, act)}
    </section>
  `;
}

function day({ done, to_finish: open, referred }) {
  return html`
    <p class="day">
      <b>${t("home.today")}</b> <span>${t("home.done", { n: done })}</span> <span>${t("home.open", { n: open })}</span>
      <span>${t("home.referred", { n: referred })}</span>
    </p>
  `;
}

const sending = ({ sent, waiting }, act) =>
  html`<button class="quiet" type="button" id="send" @click=${() => act.go({ screen: "send" })}>
    ${icon(waiting ? "wait" : "check")} <span>${t("home.sent", { n: sent })} · ${t("home.waiting", { n: waiting })}</span>
  </button>`;

function languages({ language }, act) {
  const draft = LANGUAGES[language]?.draft;
  const options = Object.entries(LANGUAGES).map(([tag, { name }]) => [tag, name]);
  return html`
    <section class="languages">
      <h2>${t("home.language")}</h2>
      ${choice({ label: t("home.language"), value: language, options, choose: act.setLanguage })}
      ${draft ? html`<p class="muted">${t("home.draft")}</p>` : nothing}
    </section>
  `;
}

export function find({ typed, visits }, act) {
  const found = (visits ?? []).filter(({ number }) => number.includes(typed) || numberWords(number).includes(typed)).slice(0, 20);
  const [one] = typed ? found : [];
  return html`
    <section class="find">
      <div>
        <h2>${t("find.title")}</h2>
        <p class="typed" aria-live="polite">${typed || "\u00a0"}</p>
        ${pad(act.typeNumber)}
        ${one
          ? html`<button class="primary" type="button" id="open-found" @click=${() => act.resume(one)}>
              ${t("find.open.one", { number: numberWords(one.number) })}
            </button>`
          : html`<p class="no-match" aria-live="polite">${typed && visits ? t("find.nomatch", { number: typed }) : "\u00a0"}</p>`}
        <button class=${one ? "" : "primary"} type="button" id="start" ?hidden=${!typed} @click=${() => act.begin(typed)}>
          ${t("find.start", { number: typed })}
        </button>
        <p class="muted">${t("find.scan")}</p>
      </div>
      <div>
        <h2 ?hidden=${typed && !found.length}>${typed ? t("home.today.typed", { number: typed }) : t("home.today")}</h2>
        ${found.length ? people(found, act.resume) : typed ? nothing : html`<p class="muted">${t("find.none")}</p>`}
      </div>
    </section>
  `;
}

/** A referral needs care, pictures go on to somebody: a tick would say that it is done. */
export const markOf = ({ code }) => (code.startsWith("refer") ? "warn" : "next");

export function people(visits, open) {
  return html`
    <ul class="people">
      ${visits.map((visit) => {
        const [name, word] = visit.outcome ? [markOf(visit.outcome), `outcome.${visit.outcome.code}`] : ["wait", "find.open"];
        return html`<li>
          <button type="button" data-visit=${visit.id} @click=${() => open(visit)}>
            <span>${personWords(visit)}</span> <span class="muted">${clockTime(visit.begun_at)}</span>
            <span class="end">${icon(name)} ${t(word)}</span>
          </button>
        </li>`;
      })}
    </ul>
  `;
}
