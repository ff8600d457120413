//! Crossings that are joined by edges of squares, numbered along the rows and columns of the board.

use std::{
    collections::{HashMap, VecDeque},
    f64::consts::{PI, TAU},
};

use super::{crossings::Crossing, picture::Picture};

/// An edge leaves a crossing and meets its neighbour within this angle of the straight line between them.
const MOST_TURN: f64 = 0.3;
/// Places along an edge at which its sides are looked at.
const PROBES: usize = 9;
/// An edge has at least this share of the contrast of its crossing.
const LEAST_CONTRAST: f64 = 0.3;
/// Nearest and farthest neighbour that is looked at, in px.
const REACH_PX: [f64; 2] = [5.0, 400.0];

/// A crossing and its place in rows and columns; the first place is arbitrary, and so is which of four turns it has.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Node {
    /// Index into the crossings.
    pub(super) crossing: usize,
    /// Column and row.
    pub(super) cell: [i32; 2],
    /// Distance to its nearest neighbour in px.
    pub(super) spacing: f64,
}

/// Steps along the grid in order of the edges, as their angles rise.
const STEPS: [[i32; 2]; 4] = [[1, 0], [0, 1], [-1, 0], [0, -1]];

/// The neighbour at the end of an edge: which crossing, and which of its edges comes back.
type Link = Option<(usize, usize)>;

/// Groups of joined crossings, largest first. Every place of a group is taken once.
pub(super) fn lattices(picture: &Picture, crossings: &[Crossing]) -> Vec<Vec<Node>> {
    let links = links(picture, crossings);
    let mut seen = vec![false; crossings.len()];
    let mut groups = Vec::new();
    for start in 0..crossings.len() {
        if seen[start] {
            continue;
        }
        // Crossing, its place, and the step that its first edge takes.
        let mut open = VecDeque::from([(start, [0, 0], 0)]);
        let mut taken: HashMap<[i32; 2], usize> = HashMap::new();
        seen[start] = true;
        while let Some((crossing, cell, first)) = open.pop_front() {
            if taken.contains_key(&cell) {
                continue;
            }
            taken.insert(cell, crossing);
            for (edge, link) in links[crossing].iter().enumerate() {
                let Some((next, back)) = *link else { continue };
                if std::mem::replace(&mut seen[next], true) {
                    continue;
                }
                let step = (first + edge) % 4;
                let there = [cell[0] + STEPS[step][0], cell[1] + STEPS[step][1]];
                // The edge that comes back takes the opposite step.
                open.push_back((next, there, (step + 2 + 4 - back) % 4));
            }
        }
        let spacing = |crossing: usize| {
            let near = links[crossing].iter().flatten().map(|&(other, _)| apart(crossings, crossing, other));
            near.fold(REACH_PX[1], f64::min)
        };
        let node = |(cell, crossing)| Node { crossing, cell, spacing: spacing(crossing) };
        let mut group: Vec<Node> = taken.into_iter().map(node).collect();
        group.sort_by_key(|node| (node.cell[1], node.cell[0]));
        groups.push(group);
    }
    groups.sort_by_key(|group| std::cmp::Reverse(group.len()));
    groups
}

fn apart(crossings: &[Crossing], one: usize, other: usize) -> f64 {
    let ([ax, ay], [bx, by]) = (crossings[one].at, crossings[other].at);
    (bx - ax).hypot(by - ay)
}

/// Neighbours along the four edges of each crossing, where both ends agree.
fn links(picture: &Picture, crossings: &[Crossing]) -> Vec<[Link; 4]> {
    let one_way: Vec<[Link; 4]> = (0..crossings.len())
        .map(|from| std::array::from_fn(|edge| neighbour(picture, crossings, from, edge)))
        .collect();
    let agreed = |from: usize, edge: usize| -> Link {
        one_way[from][edge].filter(|&(to, back)| one_way[to][back] == Some((from, edge)))
    };
    (0..crossings.len()).map(|from| std::array::from_fn(|edge| agreed(from, edge))).collect()
}

/// The nearest crossing along an edge whose own edge comes back and between which the edge is unbroken.
fn neighbour(picture: &Picture, crossings: &[Crossing], from: usize, edge: usize) -> Link {
    let own = &crossings[from];
    let mut near: Vec<(f64, usize)> = (0..crossings.len())
        .filter_map(|to| {
            let [dx, dy] = [crossings[to].at[0] - own.at[0], crossings[to].at[1] - own.at[1]];
            if dx.abs() > REACH_PX[1] || dy.abs() > REACH_PX[1] {
                return None;
            }
            let distance = dx.hypot(dy);
            let within = (REACH_PX[0]..REACH_PX[1]).contains(&distance);
            (within && turn(dy.atan2(dx), own.edges[edge]) < MOST_TURN).then_some((distance, to))
        })
        .collect();
    near.sort_by(|a, b| a.0.total_cmp(&b.0));
    near.into_iter().take(8).find_map(|(_, to)| {
        let other = &crossings[to];
        let back_angle = (own.at[1] - other.at[1]).atan2(own.at[0] - other.at[0]);
        let back = (0..4).find(|&back| turn(back_angle, other.edges[back]) < MOST_TURN)?;
        // What follows the edge here precedes the one that comes back, and sectors take turns.
        let same_sides = own.light_after(edge) != other.light_after(back);
        (same_sides && unbroken(picture, own, other, own.light_after(edge))).then_some((to, back))
    })
}

/// Angle between two directions.
fn turn(one: f64, other: f64) -> f64 {
    let difference = (one - other).rem_euclid(TAU);
    difference.min(TAU - difference).min(PI)
}

/// Whether one side of the line between two crossings is lighter all along.
fn unbroken(picture: &Picture, from: &Crossing, to: &Crossing, light_after: bool) -> bool {
    let [dx, dy] = [to.at[0] - from.at[0], to.at[1] - from.at[1]];
    let length = dx.hypot(dy);
    let offset = (0.08 * length).clamp(1.5, 3.0);
    // A quarter turn towards rising angles.
    let aside = [-dy / length * offset, dx / length * offset];
    let contrast = from.contrast.min(to.contrast);
    (0..PROBES).all(|probe| {
        let share = 0.12 + 0.76 * probe as f64 / (PROBES - 1) as f64;
        let at = [from.at[0] + share * dx, from.at[1] + share * dy];
        let after = picture.sample([at[0] + aside[0], at[1] + aside[1]]);
        let before = picture.sample([at[0] - aside[0], at[1] - aside[1]]);
        let rise = if light_after { after - before } else { before - after };
        rise > LEAST_CONTRAST * contrast
    })
}
