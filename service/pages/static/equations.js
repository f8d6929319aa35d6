// What a model is: its description, its equations as they are written by hand, its source.

import { makeElement } from './live.js';

const place = document.getElementById('about-model');

/** Write an expression with raised powers, and dots for products. Text never becomes markup. */
function writeExpression(text) {
  const line = document.createElement('code');
  for (const [part] of text.matchAll(/\*\*\s*(?:[\w.]+|\([^()]*\))|(?:(?!\*\*)[^])+?(?=\*\*|$)/g)) {
    const power = part.match(/^\*\*\s*\(?([^()]*)\)?$/);
    line.append(power ? makeElement('sup', power[1]) : part.replaceAll(/\s*\*\s*/g, '·').replaceAll('-', '−'));
  }
  return line;
}

const LEFT_SIDES = {
  differential: (state) => `d${state}/dt = `,
  difference: (state) => `${state}, next sample = `,
};

/** Show title, description, equations, outputs and source of a model. */
export function describeModel(model) {
  const writeLeft = LEFT_SIDES[model.form] ?? ((name) => `${name} = `);
  const rows = [
    ...Object.entries(model.equations ?? {}).map(([name, text]) => [writeLeft(name), text]),
    ...Object.entries(model.outputs ?? {}).map(([name, text]) => [`${name} = `, text]),
  ].filter(([, text]) => typeof text === 'string');
  const list = makeElement('div', '', 'equations');
  for (const [left, text] of rows) {
    const row = document.createElement('div');
    row.append(makeElement('i', left), writeExpression(text));
    list.append(row);
  }
  const parts = [makeElement('b', model.title ?? model.name ?? '')];
  if (rows.length) parts.push(list);
  if (model.description) parts.push(makeElement('p', model.description, 'muted'));
  if (model.source) parts.push(makeElement('p', `Source: ${model.source}`, 'muted'));
  place.replaceChildren(...parts);
}
