// Send: who waits to be sent, why, and try now. Everything else happens by itself. Loaded when first opened.

import { icon } from "../icons.js";
import { html, nothing } from "../vendor/lit-html.js";
import { calendarDay, clockTime, has, number, t } from "../words.js";

export function send({ outbox }, act) {
  if (!outbox) return nothing;
  const { configured, sent, waiting, visits, next_try_s: wait } = outbox;
  return html`
    <section class="send">
      <h2>${t("send.title")}</h2>
      <div aria-live="polite">
        <p class="verdict">${icon(waiting ? "wait" : "check")} ${t(headOf(configured, waiting), { n: waiting })}</p>
        ${configured ? html`<p>${t("send.today", { n: sent })} ${waiting ? next(wait) : ""}</p>` : nothing}
      </div>
      ${waiting
        ? html`<button class="primary" type="button" id="try-now" @click=${() => act.trySending()}>
            ${icon("again")} ${t("do.tryNow")}
          </button>`
        : nothing}
      <ul class="people">${visits.map((one) => line(one, act))}</ul>
    </section>
  `;
}

const headOf = (configured, waiting) => (!configured ? "send.off" : waiting ? "send.waiting" : "send.none");

const next = (wait) => (wait > 0 ? t("send.next", { n: Math.ceil(wait / 60) }) : t("send.soon"));

function line({ visit, number: who, since, size_bytes: size, tries, error, stuck }, act) {
  return html`<li data-stuck=${stuck}>
    <button type="button" data-visit=${visit} @click=${() => act.go({ screen: "film", visit })}>
      <span>${who}</span> <span class="muted">${calendarDay(since)}, ${clockTime(since)}</span>
      <span class="end">
        ${t("send.size", { n: number(size / 1e6) })}${tries ? ` · ${t("send.tries", { n: tries })}` : ""}
      </span>
    </button>
    ${error ? why(error, stuck) : nothing}
  </li>`;
}

function why({ code, message, remedy }, stuck) {
  const known = `why.${code}`;
  return html`<p class="why">${icon(stuck ? "warn" : "wait")} <span>${has(known) ? t(known) : `${message} ${remedy}`}</span></p>`;
}
