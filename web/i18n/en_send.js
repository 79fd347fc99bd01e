// English texts of the upload queue, part of en.js; shown only on devices that send visits.

export const SENDING = {
  "home.sent": "{n} sent",
  "home.waiting": "{n} waiting",
  "outcome.byitself": "The pictures are sent by themselves.",
  "show.waiting": "Waiting to send",

  "send.title": "Send",
  "send.off": "Nothing is sent from this device. Copy or save visits.",
  "send.none": "Nothing waits to be sent.",
  "send.waiting": { one: "{n} person waits to be sent.", other: "{n} people wait to be sent." },
  "send.today": "{n} sent today.",
  "send.soon": "It is sent when no patient is being examined.",
  "send.next": { one: "Next try in {n} minute.", other: "Next try in {n} minutes." },
  "send.size": "{n} MB",
  "send.tries": { one: "{n} try", other: "{n} tries" },
  "why.send.link": "The receiver does not answer. It is tried again by itself.",
  "why.send.certificate": "The receiver could not be trusted. Look whether the date is right.",
  "why.send.key": "The receiver does not know this device. Call the technician.",
  "why.send.refused": "The receiver does not take it. Copy it to USB.",
  "why.send.unlike": "Only a part of it arrived. Copy it to USB.",
  "why.store.damaged": "A picture is damaged. Call the technician.",
};
