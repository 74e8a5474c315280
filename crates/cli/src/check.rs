//! `fieldbeat check`: the plan in words, or as JSON.

use std::path::PathBuf;

use clap::Args;
use fieldbeat_config as config;
use fieldbeat_config::ConfigError;

use fieldbeat_core::cycle::OnCost;
use fieldbeat_core::cycle::cost::{Costs, CycleCost, Demand, Stages, Wire};
use fieldbeat_core::rt::host::rt_throttling;
use fieldbeat_core::rt::thread::may_use;
use fieldbeat_doctor::port::blocked;
use serde_json::{Value, json};

use super::{Stop, print};

/// Arguments of `check`.
#[derive(Debug, Args)]
pub struct Check {
    /// The configuration.
    config: PathBuf,
    /// Print one JSON object: the plan, or with mistakes only `errors`.
    ///
    /// Keys of a plan: `source`, `cycle`, `buses`, `drives` (each with `name`, `protocol`, `address`,
    /// `stop_bound_cycles`, `stop_bound_ns`, `drive_watchdog_ns`, `if_master_dies` and more), `groups`, and `errors`,
    /// empty unless this host cannot carry the plan. `cost` is what a cycle takes on this host (null with cost =
    /// "off"): `measured`, `usual_ns` and `worst_ns` (`send`, `receive`, `own`, `total`), and `wires` (`bus`,
    /// `interface`, `mbit_s`, `requests`, `there_ns`, `back_ns`). Each error has `file`, `line`, `key`, `value`
    /// and `message`. With errors the exit code is 2.
    #[arg(long)]
    json: bool,
}

impl Check {
    /// Runs it.
    pub fn run(self) -> Result<(), Stop> {
        let plan = match config::load(&self.config) {
            Ok(read) => read.plan,
            Err(errors) => {
                if self.json {
                    print(json!({ "errors": errors.iter().collect::<Vec<_>>() }))?;
                }
                return Err(Stop::usage(errors));
            }
        };
        // What cannot work on this host is refused here too, with the plan above it.
        let throttling = rt_throttling();
        let starving =
            throttling.and_then(|throttling| fieldbeat_core::cycle::starvation(&plan.cycle, &throttling));
        let core = plan.cycle.core.and_then(|core| may_use(core).err()).map(|why| format!("cycle.{why}"));
        let cost =
            (plan.cycle.cost != OnCost::Ignore).then(|| Demand::of(&plan).cost(&Costs::of_this_host()));
        let too_much = cost.as_ref().filter(|_| plan.cycle.cost == OnCost::Refuse);
        let too_much = too_much.and_then(CycleCost::refusal).map(|why| format!("cycle: {why}"));
        let refusal = core.or(starving).or_else(|| blocked(&plan)).or(too_much);
        if self.json {
            let file = self.config.display().to_string();
            let of_host = |message| ConfigError::of_file(file, message);
            let errors: Vec<ConfigError> = refusal.clone().map(of_host).into_iter().collect();
            let mut plan = fieldbeat_config::json::json(&plan, &errors);
            plan["cost"] = cost.as_ref().map_or(Value::Null, of_cycle);
            print(plan)?;
        } else {
            let tight = cost.iter().filter(|_| refusal.is_none()).flat_map(CycleCost::warnings);
            let of_host = cost.iter().flat_map(CycleCost::lines).chain(tight);
            let of_host = of_host.map(|line| format!("on this host: {line}"));
            let mut lines = fieldbeat_config::describe::describe(&plan);
            // What it is not stays the last line.
            let last = lines.pop();
            for line in lines.into_iter().chain(of_host).chain(last) {
                print(line)?;
            }
        }
        refusal.map_or(Ok(()), |why| Err(Stop::usage(why)))
    }
}

/// The cost of a cycle.
fn of_cycle(cost: &CycleCost) -> Value {
    let stages = |of: &Stages| {
        let [send, receive, own] = [of.send_ns, of.receive_ns, of.own_ns];
        json!({ "send": send, "receive": receive, "own": own, "total": of.total_ns() })
    };
    let wire = |Wire { bus, interface, mbit_s, count, ns: [there_ns, back_ns] }: &Wire| {
        json!({
            "bus": bus, "interface": interface, "mbit_s": mbit_s, "requests": count,
            "there_ns": there_ns, "back_ns": back_ns,
        })
    };
    json!({
        "measured": cost.measured,
        "usual_ns": stages(&cost.usual),
        "worst_ns": stages(&cost.worst),
        "wires": cost.wires.iter().map(wire).collect::<Vec<_>>(),
    })
}
