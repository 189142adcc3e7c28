//! The parameters of the node on ROS 2, asked for and set by another node.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use super::{foreign_node, ros_options};
use crate::bus::PATIENCE;
use crate::domain::Domain;
use squealcast::bus::ros2::{Parameters, Ros2};

#[test]
fn ros2_parameters_are_judged() {
    use ros2_client::rcl_interfaces::{
        DescribeParametersRequest, DescribeParametersResponse, GetParametersRequest, GetParametersResponse,
        ListParametersRequest, ListParametersResponse, SetParametersAtomicallyResponse, SetParametersRequest,
        SetParametersResponse,
    };
    use ros2_client::{Name, Parameter, ParameterValue, QosProfile, ServiceMapping, ServiceTypeName};
    let domain = Domain::claim();
    let options = ros_options(&domain);
    let accepted = Arc::new(Mutex::new(Vec::new()));
    let collecting = Arc::clone(&accepted);
    let parameters = Parameters {
        values: vec![("warn_margin".to_owned(), 0.05), ("dead_band".to_owned(), 0.0)],
        validate: Box::new(|name, value| if value < 0.0 { Err(format!("{name}: {value} is below 0")) } else { Ok(()) }),
        describe: |name| (name == "warn_margin").then_some(("what it is", [0.0, 1.0])),
        accepted: Box::new(move |name, value| collecting.lock().expect("whole").push((name.to_owned(), value))),
    };
    let _ros = Ros2::start(&options, parameters, |_| (), |_| ()).expect("node");

    let (mut node, runtime) = foreign_node(&domain, "asking");
    let profile = QosProfile::publisher_default();
    macro_rules! call {
        ($kind:literal, $name:literal, $request:expr, $response:ty) => {{
            let client = node
                .create_client::<_, $response>(
                    ServiceMapping::Enhanced,
                    &Name::new("/squealcast", $name).expect("name"),
                    &ServiceTypeName::new("rcl_interfaces", $kind),
                    profile.clone(),
                    profile.clone(),
                )
                .expect("client");
            // Asked right after discovery, on a busy machine, the node sometimes never sees the request: the client
            // then knows the service, but not yet the other way round.
            let started = Instant::now();
            loop {
                let answered = runtime.block_on(async {
                    tokio::time::timeout(Duration::from_secs(1), async {
                        client.wait_for_service(&node).await;
                        client.async_call_service($request).await.expect("answered")
                    })
                    .await
                });
                match answered {
                    Ok(answer) => break answer,
                    Err(_) => assert!(started.elapsed() < PATIENCE, "no answer: {}", $name),
                }
            }
        }};
    }
    let list: ListParametersResponse = call!(
        "ListParameters",
        "list_parameters",
        ListParametersRequest { prefixes: vec![], depth: 0 },
        ListParametersResponse
    );
    for name in ["warn_margin", "dead_band"] {
        assert!(list.result.names.iter().any(|known| known == name), "{:?}", list.result.names);
    }
    let set = |value: ParameterValue| Parameter { name: "warn_margin".to_owned(), value }.into();
    let answers: SetParametersResponse = call!(
        "SetParameters",
        "set_parameters",
        SetParametersRequest {
            parameter: vec![
                set(ParameterValue::Double(0.1)),
                set(ParameterValue::Double(-1.0)),
                set(ParameterValue::Double(f64::NAN)),
                set(ParameterValue::String("wide".to_owned())),
                set(ParameterValue::NotSet),
            ]
        },
        SetParametersResponse
    );
    let successes: Vec<bool> = answers.results.iter().map(|result| result.successful).collect();
    assert_eq!(successes, [true, false, false, false, false], "{:?}", answers.results);
    assert_eq!(answers.results[1].reason, "warn_margin: -1 is below 0");
    let got: GetParametersResponse = call!(
        "GetParameters",
        "get_parameters",
        GetParametersRequest { names: vec!["warn_margin".to_owned()] },
        GetParametersResponse
    );
    assert_eq!(got.values[0].double_value, 0.1);
    let described: DescribeParametersResponse = call!(
        "DescribeParameters",
        "describe_parameters",
        DescribeParametersRequest { names: vec!["warn_margin".to_owned(), "use_sim_time".to_owned()] },
        DescribeParametersResponse
    );
    let [margin, sim_time] = &described.values[..] else { panic!("{described:?}") };
    let range = &margin.floating_point_range[0];
    assert_eq!((&*margin.description, range.from_value, range.to_value), ("what it is", 0.0, 1.0));
    assert!(sim_time.read_only && !margin.read_only, "{described:?}");
    let of = |name: &str, value| Parameter { name: name.to_owned(), value }.into();
    let set_together: SetParametersAtomicallyResponse = call!(
        "SetParametersAtomically",
        "set_parameters_atomically",
        SetParametersRequest {
            parameter: vec![
                of("warn_margin", ParameterValue::Double(0.7)),
                of("use_sim_time", ParameterValue::Boolean(true)),
            ]
        },
        SetParametersAtomicallyResponse
    );
    assert_eq!(
        (set_together.result.successful, &*set_together.result.reason),
        (false, "use_sim_time is not supported: times are those of this machine"),
        "neither is set"
    );
    let mut accepted = accepted.lock().expect("whole");
    accepted.dedup();
    assert_eq!(*accepted, [("warn_margin".to_owned(), 0.1)], "initial and refused values are not passed on");
}

#[test]
fn a_refused_initial_value_is_an_error() {
    let parameters = Parameters {
        values: vec![("warn_margin".to_owned(), -1.0)],
        validate: Box::new(|_, _| Err("below 0".to_owned())),
        ..Parameters::none()
    };
    let domain = Domain::claim();
    let error = Ros2::start(&ros_options(&domain), parameters, |_| (), |_| ()).err().expect("refused").to_string();
    assert!(error.contains("below 0"), "{error}");
}
