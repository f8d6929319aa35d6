// What all forms share: the table of bounds, submission, problem documents beside the fields they are about.

import { Problem, element, post } from './live.js';

const COLUMNS = ['lower', 'upper', 'fixed'];
const rows = document.getElementById('parameters');
let kept = {}; // what was asked for and has no field

/** What has bounds: parameters, and the starts that are estimated, of the first experiment. */
function bounded(model) {
  const starts = Object.entries(model.initial ?? {}).filter(([, start]) => start?.upper !== undefined);
  const unit = (state) => model.states?.[state] ?? '–';
  return { ...model.parameters, ...Object.fromEntries(starts.map(([state, start]) => [`${state}(0)`, { ...start, unit: unit(state) }])) };
}

/** Scales, ties, and starts of later experiments, as x(0)[2]: an earlier job may ask for them. */
function withoutField(known, changes) {
  const asked = Object.entries(changes).filter(([name]) => name.replace(/\[\d+\]$/, '') in known);
  const left = asked.map(([name, fields]) => [name, Object.entries(fields).filter(([key]) => !(name in known && COLUMNS.includes(key)))]);
  return Object.fromEntries(left.filter(([, fields]) => fields.length).map(([name, fields]) => [name, Object.fromEntries(fields)]));
}

/** One row per parameter of the model, with the bounds of the model or those that were asked for. */
export function fillTable(model, changes) {
  const known = bounded(model);
  kept = withoutField(known, changes);
  const made = Object.entries(known).map(([name, own]) => {
    const row = document.createElement('tr');
    row.append(element('th', name));
    for (const column of COLUMNS) {
      const input = document.createElement('input');
      input.inputMode = 'decimal';
      input.ariaLabel = `${column} of ${name}`;
      input.dataset.parameter = name;
      input.dataset.column = column;
      input.dataset.pointer = `/parameters/${name}/${column}`;
      input.dataset.known = own?.[column] ?? '';
      input.value = changes[name]?.[column] ?? input.dataset.known;
      row.append(document.createElement('td'));
      row.lastChild.append(input);
    }
    row.append(element('td', own?.unit ?? '–', 'muted'));
    return row;
  });
  rows.replaceChildren(...made);
}

/** What differs from the model, as the job body wants it. */
export function overrides() {
  const found = structuredClone(kept);
  for (const input of rows.querySelectorAll('input')) {
    const text = input.value.trim();
    if (text === '' || text === input.dataset.known) continue;
    const value = Number.isNaN(Number(text)) ? text : Number(text);
    (found[input.dataset.parameter] ??= {})[input.dataset.column] = value;
  }
  return found;
}

/** Put every fault beside the field that its pointer names, or the nearest above it. */
export function showFaults(form, problem) {
  const top = form.querySelector('#form-fault');
  problem.errors.forEach((fault) => beside(form, fault));
  const summary = problem.errors.length ? 'The request is invalid:' : problem.document.title;
  top.replaceChildren(element('b', summary));
  const list = document.createElement('ul');
  const texts = problem.errors.length ? problem.errors.map(said) : [problem.message];
  texts.forEach((text) => list.append(element('li', text)));
  top.append(list);
  top.hidden = false;
  (form.querySelector('[aria-invalid="true"]') ?? top).focus();
}

const said = ({ pointer, detail, column }) =>
  `${pointer ? `${pointer}: ` : ''}${detail}${column ? ` (column ${column})` : ''}`;

function beside(form, fault) {
  const parts = (fault.pointer ?? '').split('/');
  for (; parts.length > 1; parts.pop()) {
    const pointer = parts.join('/');
    const input = form.querySelector(`:is(input, select, textarea)[data-pointer="${CSS.escape(pointer)}"]`);
    const place = form.querySelector(`[data-fault="/${CSS.escape(parts[1])}"]`);
    if (input) input.ariaInvalid = 'true';
    if ((input || parts.length === 2) && place) {
      place.textContent = [place.textContent, said(fault)].filter(Boolean).join('; ');
      return true;
    }
  }
  return false;
}

export function clearFaults(form) {
  form.querySelectorAll('.fault[data-fault]').forEach((one) => (one.textContent = ''));
  form.querySelectorAll('[aria-invalid]').forEach((one) => one.removeAttribute('aria-invalid'));
  form.querySelector('#form-fault').hidden = true;
}

/** What the form is about to do, or why it does not. */
export const say = (form, text) => (form.querySelector('#form-state').textContent = text);

/** Choices whose answers are still on their way: without them a request would lack what they bring. */
let going = null;

async function settled() {
  for (let seen; seen !== going; ) {
    seen = going;
    await seen;
  }
}

/** Send the body that `make` gives when a form that is ready is submitted; faults go to their fields. */
export function submits(form, url, make, isReady = async () => true) {
  form.addEventListener('submit', async (event) => {
    event.preventDefault();
    clearFaults(form);
    const button = form.querySelector('[type="submit"]');
    button.disabled = true;
    say(form, 'submitting…');
    try {
      await settled();
      if (!(await isReady())) {
        button.disabled = false;
        return;
      }
      const job = await post(url, make());
      location.assign(`/jobs/${encodeURIComponent(job.id)}`);
    } catch (error) {
      if (!(error instanceof Problem)) throw error;
      say(form, '');
      showFaults(form, error);
      button.disabled = false;
    }
  });
}

/** What a choice sets going may be refused; the refusal is shown, never lost. */
export const shown = (form, work) => async (...given) => {
  const done = work(...given);
  going = Promise.allSettled([going, done]);
  try {
    await done;
  } catch (error) {
    if (!(error instanceof Problem)) throw error;
    showFaults(form, error);
  }
};
